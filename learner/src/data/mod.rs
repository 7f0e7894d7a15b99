//! Finds or fetches the data that a run learns from.
//!
//! It has no thread: `learner train` and `learner datasets` call it on the main thread before a run
//! begins.
//!
//! In reading order: `source` parses `--dataset`; `cache` are the folders; `fetch` gets a file of
//! the catalog from one address after the other; `transfer` is one attempt at one address; `partial`
//! is a file that has arrived in part; `verify` checks the file. `load` reads its transitions.

pub(crate) mod cache;
mod fetch;
mod load;
mod partial;
mod source;
mod transfer;
mod verify;

pub(crate) use fetch::LocalDataset;
pub(crate) use load::{load, warnings};
pub(crate) use source::Source;
