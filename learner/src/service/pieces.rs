//! Online episodes that arrive in pieces, of one evaluator or of several.

use std::collections::BTreeMap;
use std::mem;
use std::sync::Arc;

use quad_protocol::{Hash, Piece};

/// Frames that are not on the disk yet, by their episodes' seeds. There are as many as the run has
/// open episodes, and none is longer than the environment allows.
#[derive(Debug, Default)]
pub(super) struct Pieces(BTreeMap<u64, Partial>);

#[derive(Debug)]
struct Partial {
    /// Hash of the whole frame.
    hash: Hash,
    /// The first bytes of the frame; none while it is given out.
    bytes: Vec<u8>,
    /// True while the whole frame is given out.
    whole: bool,
}

impl Partial {
    fn new(hash: Hash) -> Self {
        Self { hash, bytes: Vec::new(), whole: false }
    }
}

#[derive(Debug, PartialEq)]
pub(super) enum Added {
    /// The next piece is to begin at this byte.
    Continue(u32),
    /// The frame, which is given out.
    Whole(Arc<Vec<u8>>),
}

impl Pieces {
    /// Adds a piece. Only the first that completes a frame gets it.
    pub fn add(&mut self, piece: &Piece) -> Added {
        let partial = self.0.entry(piece.seed).or_insert_with(|| Partial::new(piece.hash));
        if partial.whole {
            return Added::Continue(piece.offset);
        }
        if partial.hash != piece.hash {
            if piece.offset > 0 {
                return Added::Continue(0);
            }
            *partial = Partial::new(piece.hash);
        }
        if piece.offset as usize == partial.bytes.len() {
            partial.bytes.extend_from_slice(&piece.bytes);
        }
        if partial.bytes.len() < piece.length as usize {
            return Added::Continue(partial.bytes.len() as u32);
        }
        partial.whole = true;
        Added::Whole(Arc::new(mem::take(&mut partial.bytes)))
    }

    /// Takes a frame back that could not be written: its last piece completes it again.
    pub fn give_back(&mut self, seed: u64, frame: Arc<Vec<u8>>) {
        if let Some(partial) = self.0.get_mut(&seed) {
            (partial.bytes, partial.whole) = (Arc::unwrap_or_clone(frame), false);
        }
    }

    /// Removes a frame that is on the disk, or no episode.
    pub fn remove(&mut self, seed: u64) {
        self.0.remove(&seed);
    }
}
