//! Reads D4RL, Minari, OGBench and custom HDF5, yields transitions and mini-batches, and writes
//! D4RL's and custom HDF5.
//!
//! # Layout
//! In reading order: [`environment`] is all that is known of an environment, `simulated` that part
//! of it by which evaluators simulate it; `task` is one that may be unknown. `hdf5_file` and
//! `npz_file` read one `array` of a file and check everything about its form; `foreign` names what
//! is not read here. `formats` has a file for each format, which turns arrays into a `recording`.
//! `transitions` are what is learned from, unless `checks` has objections, with `reward`, `scale`
//! and `statistics` beside it; `doubts` are what makes learning from them doubtful, `rounding` what
//! does not; `sampler` draws mini-batches; `inspect` describes a source to people, whatever is
//! wrong with it. `recorded` is a D4RL file as it was recorded, row by row; `writer` writes such a
//! file, and `arrays` one of the custom layout, both by `new_file`. [`catalog`] lists the files
//! that can be asked for by name, [`ogbench`] what OGBench's names mean; `error` is what can go
//! wrong with any of them.
//!
//! This crate knows nothing of networks, simulators or the wire.

#![deny(unsafe_code)]

mod array;
mod arrays;
pub mod catalog;
mod checks;
mod doubts;
pub mod environment;
mod error;
mod foreign;
mod formats;
mod hdf5_file;
mod hold_out;
mod inspect;
mod new_file;
mod npz_file;
pub mod ogbench;
mod recorded;
mod recording;
mod reward;
mod rounding;
mod sampler;
mod scale;
mod simulated;
mod statistics;
mod task;
mod transitions;
mod writer;

pub use arrays::{Arrays, Names, write_own};
pub use catalog::NamedDataset;
pub use environment::{EnvironmentSpec, Goal, UnknownEnvironment};
pub use error::{DatasetError, Problem};
pub use formats::{data_file, minari_folder, recorded_environment};
pub use hdf5_file::hdf5_library;
pub use hold_out::{HoldOut, Split};
pub use inspect::{Inspection, inspect};
pub use recorded::{RecordedRows, Row, environments_of_its_sizes};
pub use reward::RewardRule;
pub use sampler::BatchSampler;
pub use scale::{Scale, Scaled};
pub use simulated::{Collect, Healthy, Noise, Planar, Recipe};
pub use statistics::Statistics;
pub use task::Task;
pub use transitions::{Batch, ReadOptions, Transitions};
pub use writer::{D4rlWriter, Metadata};
