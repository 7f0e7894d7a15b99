//! An online episode, as far as it has come.

use std::mem;
use std::sync::Arc;

use quad_protocol::{Hash, Piece};

/// An online episode as the learner knows it.
#[derive(Debug)]
pub(super) enum OnlineEpisode {
    /// An earlier incarnation may have opened it. Training opens it again when it comes there.
    Expected,
    /// Evaluators may play the episode of this number.
    Open(u64, Partial),
    /// It is on the disk, with a frame of this hash.
    Recorded(Hash),
}

/// The frame of an open episode, as far as it has come. None is longer than the environment allows.
#[derive(Debug, Default)]
pub(super) struct Partial {
    /// Hash of the whole frame.
    hash: Option<Hash>,
    /// The first bytes of the frame; none while it is given out.
    pub bytes: Vec<u8>,
    /// True while the whole frame is decoded or written.
    pub given_out: bool,
}

impl Partial {
    /// Adds a piece, and gives the frame out if that completes it. Otherwise returns where the next
    /// piece is to begin.
    pub fn add(&mut self, piece: &Piece) -> Result<Arc<Vec<u8>>, u32> {
        if self.given_out {
            return Err(piece.offset);
        }
        if self.hash != Some(piece.hash) {
            if piece.offset > 0 {
                return Err(0);
            }
            *self = Self { hash: Some(piece.hash), ..Self::default() };
        }
        if piece.offset as usize == self.bytes.len() {
            self.bytes.extend_from_slice(&piece.bytes);
        }
        if self.bytes.len() < piece.length as usize {
            return Err(self.bytes.len() as u32);
        }
        self.given_out = true;
        Ok(Arc::new(mem::take(&mut self.bytes)))
    }
}
