//! Deliveries between their arrival and their acknowledgment.

use std::collections::VecDeque;

use quad_protocol::{Episode, EpisodeScore, Piece, ScoreReport};

use super::message::Frame;

/// Most deliveries that wait for the disk; the senders of more try again.
const MOST_WAITING: usize = 1024;

#[derive(Debug)]
pub(super) struct Deliveries<Q> {
    /// Those that wait for the disk.
    pub reports: VecDeque<(Q, ScoreReport)>,
    pub pieces: VecDeque<(Q, Piece)>,
    /// Number of frames that are decoded.
    pub decoding: usize,
    /// Reports that are written, or about to be, with their new scores.
    pub writing_scores: Vec<(Q, ScoreReport, Vec<EpisodeScore>)>,
    /// Online episodes that are written, or about to be.
    pub writing_episodes: Vec<(Frame<Q>, Box<Episode>)>,
    pub appending: bool,
}

impl<Q> Deliveries<Q> {
    pub fn new() -> Self {
        Self {
            reports: VecDeque::new(),
            pieces: VecDeque::new(),
            decoding: 0,
            writing_scores: Vec::new(),
            writing_episodes: Vec::new(),
            appending: false,
        }
    }

    pub fn is_busy(&self) -> bool {
        self.decoding > 0 || self.appending
    }

    pub fn is_full(&self) -> bool {
        self.reports.len() + self.pieces.len() >= MOST_WAITING
    }
}
