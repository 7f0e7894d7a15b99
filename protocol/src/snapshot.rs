//! Weights, from the learner to evaluators.

use crate::codec::{Decode, Encode};
use crate::{Hash, Name};

/// What is needed beside the tensors to act with them: environment and shapes of the networks.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Schema {
    /// Environment that the policy acts in.
    pub environment: String,
    /// Numbers in an observation.
    pub observation_dim: u32,
    /// Numbers in an action.
    pub action_dim: u32,
    /// Units of each hidden layer.
    pub hidden: u32,
    /// Critics in the ensemble (the paper's K).
    pub critics: u32,
    /// Denoising steps of the actor (the paper's T).
    pub diffusion_steps: u32,
}

/// Target actor and target critics of one run after one gradient step.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Snapshot {
    /// The run.
    pub run: Name,
    /// Which start of its learner published it: one that is started again has a higher number.
    pub incarnation: u64,
    /// Gradient steps so far.
    pub step: u64,
    /// Environment and shapes.
    pub schema: Schema,
    /// BLAKE3 hash of exactly the bytes in `tensors`. Decoding verifies it.
    pub hash: Hash,
    /// A whole safetensors file. It is not looked into here.
    pub tensors: Vec<u8>,
}
