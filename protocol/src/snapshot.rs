//! Weights, from the learner to evaluators.

use bincode::{Decode, Encode};

use crate::codec::{CodecError, LARGE, Message};
use crate::hash::Hash;
use crate::name::Name;

/// Most bytes of a snapshot's frame that are not its file.
const BESIDE_THE_FILE: usize = 256;

/// The policy of one run after one gradient step.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Snapshot {
    /// The run.
    pub run: Name,
    /// Which start of its learner published it: one that is started again has a higher number.
    pub incarnation: u64,
    /// Gradient steps so far.
    pub step: u64,
    /// BLAKE3 hash of exactly the bytes in `file`. Decoding verifies it.
    pub hash: Hash,
    /// The policy's whole safetensors file. Its header says what policy it is, and its
    /// [`Origin`](crate::Origin). It is not looked into here.
    pub file: Vec<u8>,
}

impl Snapshot {
    /// Largest file that can be sent, bytes.
    pub const MOST_FILE: usize = LARGE - BESIDE_THE_FILE;
}

impl Message for Snapshot {
    const KIND: u8 = 1;
    const LIMIT: usize = LARGE;

    fn verify(&self) -> Result<(), CodecError> {
        let found = Hash::of(&self.file);
        if found == self.hash {
            Ok(())
        } else {
            Err(CodecError::Hash { claimed: self.hash, found })
        }
    }
}
