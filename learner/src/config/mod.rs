//! What a run was asked to do: a preset with the command line's changes on top, resolved once and checked.
//!
//! Owns the embedded presets and the format of a run's `config.toml`. It has no state and no thread: every room above may
//! call it, from any thread. It imports the list of [`algorithms`](crate::algorithms), whose hyper-parameters it checks, and
//! nothing else of the learner.
//!
//! In reading order: `presets` are the TOML tables; `experiment` is one of them, resolved; `run_config` is what a run's
//! folder says of itself; `schedule` tells which steps are evaluated; `settings` compares two runs key by key; `device` and
//! `nearest` are small parts of these.

mod device;
mod experiment;
mod nearest;
pub(crate) mod presets;
mod run_config;
mod schedule;
pub(crate) mod settings;

pub use device::Device;
pub use experiment::{Experiment, resolve};
pub(crate) use nearest::did_you_mean;
pub use run_config::{DatasetInfo, RunConfig, RunInfo};
pub use schedule::Schedule;
