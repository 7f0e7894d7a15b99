//! Weights, from the learner to evaluators.

use bincode::{Decode, Encode};

use crate::codec::{CodecError, LARGE, Message};
use crate::hash::Hash;
use crate::name::Name;

/// What a snapshot says of its policy beside the tensors. The shapes of the networks are in the tensors' own file.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Schema {
    /// Environment that the policy acts in.
    pub environment: String,
    /// Numbers in an observation.
    pub observation_dim: u32,
    /// Numbers in an action.
    pub action_dim: u32,
    /// Kind of policy that the tensors are, which decides how they are acted with: e.g. `diffusion`, a diffusion policy
    /// with critics that choose the best of several candidates, or `gaussian`.
    pub policy: String,
}

impl Schema {
    /// Most bytes in the name of an environment or of a kind of policy. Decoding refuses longer ones.
    pub const MAX_NAME_LENGTH: usize = 64;
}

/// The policy of one run after one gradient step.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Snapshot {
    /// The run.
    pub run: Name,
    /// Which start of its learner published it: one that is started again has a higher number.
    pub incarnation: u64,
    /// Gradient steps so far.
    pub step: u64,
    /// Environment and kind of policy.
    pub schema: Schema,
    /// BLAKE3 hash of exactly the bytes in `tensors`. Decoding verifies it.
    pub hash: Hash,
    /// A whole safetensors file with the shapes of its networks and its [`Origin`](crate::Origin) in its metadata. It is
    /// not looked into here.
    pub tensors: Vec<u8>,
}

impl Message for Snapshot {
    const KIND: u8 = 1;
    const LIMIT: usize = LARGE;

    fn verify(&self) -> Result<(), CodecError> {
        for (field, text) in [("environment", &self.schema.environment), ("policy", &self.schema.policy)] {
            let (length, most) = (text.len(), Schema::MAX_NAME_LENGTH);
            if length > most {
                return Err(CodecError::Malformed(format!(
                    "the {field} has {length} bytes, at most {most} are allowed"
                )));
            }
        }
        let found = Hash::of(&self.tensors);
        if found == self.hash { Ok(()) } else { Err(CodecError::Hash { claimed: self.hash, found }) }
    }
}
