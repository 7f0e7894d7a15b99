//! The data that a run learns from: found on this machine, or fetched.
//!
//! Owns D4RL's cache folder of files and what is on its way into it. It has no thread: `learner train` and `learner datasets`
//! call it on the main thread before a run begins, and it returns when the file is there. It uses `config` for what a run's
//! settings say of its data and the nearest name of a misspelt one, and imports nothing else of the learner.
//!
//! In reading order: `source` is what `--dataset` means; `cache` is the folder; `fetch` gets a file of the catalogue into it,
//! from one address after the other; `transfer` is one attempt at one address; `partial` is what has arrived so far; `verify`
//! tells whether it is the right file. `load` reads the file's transitions for a run.

pub(crate) mod cache;
mod fetch;
mod load;
mod partial;
mod source;
mod transfer;
mod verify;

pub(crate) use fetch::LocalDataset;
pub(crate) use load::load;
pub(crate) use source::Source;
