//! Practice episodes that arrive in pieces, of one evaluator or of several.

use std::collections::BTreeMap;

use quad_protocol::{CodecError, Episode, Hash, Piece, decode};

/// Frames that are not on the disk yet, by their episodes' seeds.
#[derive(Debug, Default)]
pub(crate) struct Pieces(BTreeMap<u64, Partial>);

#[derive(Debug)]
struct Partial {
    /// Hash of the whole frame.
    hash: Hash,
    bytes: Vec<u8>,
    /// True if a piece of the same batch has completed it.
    whole: bool,
}

impl Partial {
    fn new(hash: Hash) -> Self {
        Self { hash, bytes: Vec::new(), whole: false }
    }
}

#[derive(Debug, PartialEq)]
pub(crate) enum Added {
    /// The next piece is to begin at this byte.
    Continue(u32),
    Whole(Episode),
}

impl Pieces {
    /// Begins a batch of pieces, which are written together. What an earlier one has completed and
    /// is still here was not written: its last piece completes it again.
    pub fn begin(&mut self) {
        self.0.values_mut().for_each(|partial| partial.whole = false);
    }

    /// Adds a piece. Only the first that completes an episode in a batch gets it.
    ///
    /// # Errors
    /// The frame is not what its hash says, or no episode.
    pub fn add(&mut self, piece: &Piece) -> Result<Added, CodecError> {
        let partial = self.0.entry(piece.seed).or_insert_with(|| Partial::new(piece.hash));
        if partial.whole {
            return Ok(Added::Continue(piece.offset));
        }
        if partial.hash != piece.hash {
            if piece.offset > 0 {
                return Ok(Added::Continue(0));
            }
            *partial = Partial::new(piece.hash);
        }
        let Partial { bytes, whole, .. } = partial;
        if piece.offset as usize == bytes.len() {
            bytes.extend_from_slice(&piece.bytes);
        }
        if bytes.len() < piece.length as usize {
            return Ok(Added::Continue(bytes.len() as u32));
        }
        let found = Hash::of(bytes);
        if found != piece.hash {
            bytes.clear();
            return Err(CodecError::Hash { claimed: piece.hash, found });
        }
        let episode = decode(bytes)?;
        *whole = true;
        Ok(Added::Whole(episode))
    }

    /// The frame of an episode, as far as it is here.
    pub fn frame(&self, seed: u64) -> Option<&[u8]> {
        self.0.get(&seed).map(|partial| partial.bytes.as_slice())
    }

    /// Removes the frame of an episode. Returns its hash.
    pub fn remove(&mut self, seed: u64) -> Option<Hash> {
        self.0.remove(&seed).map(|partial| partial.hash)
    }
}
