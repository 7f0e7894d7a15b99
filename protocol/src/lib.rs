//! The wire between a learner and its evaluators.
//!
//! # Layout
//!
//! In reading order: `name` and `hash`; [`keys`]; `snapshot`, weights and the header of their file;
//! `seeds` and `job`, the episodes that an evaluator runs; `score`; `experience`; `codec`, messages to
//! bytes and back.
//!
//! Nothing here knows what the weights mean or how episodes are simulated.

#![deny(unsafe_code)]

mod codec;
mod experience;
mod hash;
mod job;
pub mod keys;
mod name;
mod score;
mod seeds;
mod snapshot;

pub use codec::{CodecError, Message, PROTOCOL_VERSION, decode, decode_from, decode_kept, encode};
pub use experience::{Episode, Piece, PieceReply};
pub use hash::Hash;
pub use job::{Exploration, Job, JobReply, JobRequest, Progress};
pub use name::{InvalidName, Name};
pub use score::{EpisodeScore, ScoreReply, ScoreReport};
pub use seeds::{episode_seeds, online_seed};
pub use snapshot::{Origin, Snapshot};
