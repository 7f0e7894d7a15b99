//! The settings of a run: an algorithm's values for a task, changed by the command line, resolved
//! once and checked.
//!
//! Owns the embedded tasks and the format of a run's `config.toml`. It has no state and no thread:
//! every module above may call it, from any thread. The hyper-parameters are checked by their
//! algorithm, in [`quad_algorithms`].
//!
//! In reading order: `tasks` are the tasks, `hyperparameters` an algorithm's values for them,
//! `presets` the task or file from which a user starts; `experiment` is all of that, resolved;
//! `run_config` is the content of `config.toml`; `schedule` tells which steps are evaluated;
//! `settings` compares two runs key by key; `device`, `nearest` and `tables` are small parts of
//! these.

mod device;
mod experiment;
pub mod hyperparameters;
mod nearest;
pub mod presets;
mod run_config;
mod schedule;
pub mod settings;
pub mod tables;
pub mod tasks;

pub use device::Device;
pub use experiment::Experiment;
pub use nearest::did_you_mean;
pub use presets::Preset;
pub use presets::resolve;
pub use run_config::{DatasetInfo, RunConfig, RunInfo};
pub use schedule::Schedule;
