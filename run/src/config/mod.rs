//! Settings of a run: an algorithm's values for a task, changed by the command line, and checked.
//!
//! In reading order: `tasks`; `hyperparameters`, an algorithm's values for them; `presets`, a task
//! or a file; `experiment`, all of that resolved; `run_config`, the contents of `config.toml`;
//! `online`, the online steps; `schedule`, the evaluated steps; `settings`, which compares runs key by
//! key; `tables`.

mod error;
mod experiment;
pub mod hyperparameters;
mod online;
pub mod presets;
mod run_config;
mod schedule;
pub mod settings;
pub mod tables;
pub mod tasks;

pub use error::{ConfigError, did_you_mean};
pub use experiment::Experiment;
pub use online::Online;
pub use presets::{Preset, resolve};
pub use run_config::{DatasetInfo, Device, RunConfig, RunInfo};
pub use schedule::Schedule;
