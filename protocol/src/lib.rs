//! What crosses the wire between a learner and its evaluators.
//!
//! # Layout
//!
//! In reading order:
//!
//! - `name`: what runs and evaluators may be called; `hash`: how weights are identified.
//! - [`keys`]: where on Zenoh each message is found.
//! - `snapshot`: weights, from the learner to evaluators; `origin`: what the header of their file
//!   says of where it comes from.
//! - `seeds`: which episodes an evaluation has; `job`: an evaluator asks for work and gets some.
//! - `progress`: an evaluator tells how far its job is.
//! - `score`: an evaluator delivers scores, the learner acknowledges them.
//! - `codec`: messages to bytes and back.
//!
//! Nothing here knows what the weights mean or how episodes are simulated.

#![deny(unsafe_code)]

mod codec;
mod hash;
mod job;
pub mod keys;
mod name;
mod origin;
mod progress;
mod score;
mod seeds;
mod snapshot;

pub use codec::{CodecError, Message, PROTOCOL_VERSION, decode, decode_from, encode};
pub use hash::Hash;
pub use job::{Job, JobReply, JobRequest};
pub use name::{InvalidName, Name};
pub use origin::Origin;
pub use progress::Progress;
pub use score::{EpisodeScore, ScoreReply, ScoreReport};
pub use seeds::episode_seeds;
pub use snapshot::Snapshot;
