//! Deliveries between their arrival and their acknowledgment.

use std::collections::VecDeque;

use quad_protocol::{Episode, Piece, ScoreReport};

use super::message::Frame;
use super::pieces::Pieces;
use super::validate::Validated;

/// Deliveries that wait for the disk, or are written.
#[derive(Debug)]
pub(super) struct Deliveries<Q> {
    pub arrived: VecDeque<Arrival<Q>>,
    pub pieces: Pieces,
    /// Number of frames that are decoded.
    pub decoding: usize,
    /// What is written, or about to be.
    pub writing: Vec<Writing<Q>>,
    pub appending: bool,
}

#[derive(Debug)]
pub(super) enum Arrival<Q> {
    Scores(Q, ScoreReport),
    Piece(Q, Piece),
}

#[derive(Debug)]
pub(super) enum Writing<Q> {
    Scores(Q, ScoreReport, Validated),
    Episode(Frame<Q>, Box<Episode>),
}

impl<Q> Default for Deliveries<Q> {
    fn default() -> Self {
        Self {
            arrived: VecDeque::new(),
            pieces: Pieces::default(),
            decoding: 0,
            writing: Vec::new(),
            appending: false,
        }
    }
}
