//! Finds or fetches the data that a run learns from.
//!
//! Owns the fetches into D4RL's and OGBench's cache folders. It has no thread: `learner train` and
//! `learner datasets` call it on the main thread before a run begins, and it returns when the file
//! is on this machine. It uses `config` for a run's settings of its data and to suggest names, and
//! imports nothing else of the learner.
//!
//! In reading order: `source` parses `--dataset`; `cache` are the folders; `fetch` gets a file of
//! the catalog into one, from one address after the other; `transfer` is one attempt at one
//! address; `partial` is a file that has arrived in part; `verify` checks the file. `load` reads
//! the file's transitions for a run.

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
