//! Reads D4RL, Minari, OGBench and custom HDF5 datasets, samples mini-batches of transitions, and
//! writes D4RL's and the custom layout.
//!
//! # Layout
//! `tables` has the known environments, benchmarks and datasets. `formats` reads each format into a
//! `recording`, and writes files; `online` is an episode that joins a dataset. `checks` refuses
//! bad recordings, `warnings` reports suspicious ones, `normalize` scales them, `transitions` serves
//! them. `inspect` prints a summary.

#![deny(unsafe_code)]

mod checks;
mod error;
mod files;
mod formats;
mod inspect;
mod normalize;
mod online;
mod recording;
mod same_state;
mod statistics;
mod tables;
mod transitions;
mod warnings;

pub use error::{ArrayProblem, DatasetError, Load, Problem, RowProblem};
pub use files::DatasetFile;
pub use formats::arrays::{Arrays, write_own};
pub use formats::d4rl_writer::{D4rlWriter, Metadata, write_experience};
pub use formats::hdf5_file::hdf5_library;
pub use formats::recorded::{RecordedRows, RecordedStep, matching_environments};
pub use formats::{ReadOptions, data_file, minari_folder, recorded_environment};
pub use inspect::{Inspection, inspect};
pub use normalize::Normalize;
pub use online::OnlineEpisode;
pub use recording::Names;
pub use tables::catalog::NamedDataset;
pub use tables::environment::{D4rl, EnvironmentSpec, UnknownEnvironment};
pub use tables::maze::{CELL, GoalDraw, Judged, MazeTask};
pub use tables::reward::RewardRule;
pub use tables::simulator::{Drive, Healthy, Noise, Planar, Recipe, Robot, Simulator};
pub use tables::task::Task;
pub use tables::{benchmarks, catalog, environment};
pub use transitions::hold_out::HoldOut;
pub use transitions::sampler::{BatchSampler, OnlineSampler};
pub use transitions::statistics::Statistics;
pub use transitions::{Batch, Split, Transitions, Window};
