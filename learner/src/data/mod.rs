//! Finds or fetches the data that a run learns from.
//!
//! It has no thread: `learner train` and `learner datasets` call it on the main thread before a run
//! begins.
//!
//! In reading order: `source` parses `--dataset`; `fetch` gets a file of
//! the catalog from one address after the other; `transfer` is one attempt at one address. `load`
//! reads a file's transitions.

mod fetch;
mod load;
mod source;
mod transfer;

pub(crate) use load::load;
pub(crate) use source::{Source, cache_folder, cached, made_folder, obtain};
