//! What the files mean: D4RL HDF5 in, transitions and mini-batches out; and D4RL HDF5 written.
//!
//! # Layout
//! In reading order: [`environment`] is what is known of an environment without simulating it; [`task`] is one that may
//! be unknown; `file` reads one array of
//! an HDF5 file and checks everything about it; [`transitions`] turns arrays into transitions, with [`reward`] and
//! [`statistics`] beside it; [`sampler`] draws mini-batches; [`recorded`] is a file as it was recorded, row by row;
//! [`writer`] writes such a file; [`catalogue`] lists the files that can be asked for by name; [`error`] is what can go wrong with any of them.
//!
//! This crate knows nothing of networks, simulators or the wire.

#![deny(unsafe_code)]

pub mod catalogue;
pub mod environment;
pub mod error;
mod file;
pub mod recorded;
pub mod reward;
pub mod sampler;
pub mod statistics;
pub mod task;
pub mod transitions;
pub mod writer;

pub use catalogue::NamedDataset;
pub use environment::{EnvironmentSpec, Goal, UnknownEnvironment};
pub use error::DatasetError;
pub use recorded::{RecordedRows, Row, environments_of_its_sizes, recorded_environment};
pub use reward::RewardRule;
pub use sampler::{Batch, BatchSampler};
pub use statistics::Statistics;
pub use task::Task;
pub use transitions::{ReadOptions, Transitions};
pub use writer::{D4rlWriter, Metadata};
