//! Weights, from the learner to evaluators, and where they come from.

use bincode::{Decode, Encode};
use serde::{Deserialize, Serialize};

use crate::codec::{CodecError, LARGE, Message};
use crate::hash::Hash;
use crate::name::Name;

/// Most bytes of a snapshot's frame without the file.
const OVERHEAD: usize = 256;

/// The policy of a run after a gradient step.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Snapshot {
    /// Name of the run.
    pub run: Name,
    /// The learner's incarnation: larger each time the run's learner starts.
    pub incarnation: u64,
    /// Gradient step.
    pub step: u64,
    /// BLAKE3 hash of `file`, verified by decoding.
    pub hash: Hash,
    /// The policy's safetensors file, opaque here. Its header has the kind of policy and its
    /// [`Origin`].
    pub file: Vec<u8>,
}

impl Snapshot {
    /// Largest file that can be sent, bytes.
    pub const MOST_FILE: usize = LARGE - OVERHEAD;
}

impl Message for Snapshot {
    const KIND: u8 = 1;
    const LIMIT: usize = LARGE;

    fn verify(&self) -> Result<(), CodecError> {
        let (claimed, actual) = (self.hash, Hash::new(&self.file));
        if actual == claimed { Ok(()) } else { Err(CodecError::Hash { claimed, actual }) }
    }
}

/// Origin and evaluation of a snapshot, in the header of its file. It is a function of the run's
/// configuration, so that equal configurations make equal bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    /// Name of the environment.
    pub environment: String,
    /// Seed of the run, which with `step` decides the [episodes](crate::episode_seeds).
    pub seed: u64,
    /// Gradient step.
    pub step: u64,
    /// Episodes of the evaluation.
    pub episodes: u32,
}
