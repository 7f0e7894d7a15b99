//! Runs on the disk: a run's settings, its folder, its results and its state. It is the one reader
//! of what a learner writes.
//!
//! It has no thread; every program calls it on threads of its own. In reading order; each module
//! may use those below it:
//!
//! - [`status`]: how far runs are, and a list of all runs.
//! - [`results`]: a run's scores, summarized, and the paper's.
//! - [`folder`]: a run's folder.
//! - [`config`]: a run's settings.
//! - [`table`]: a table as text, Markdown, LaTeX and CSV.
//! - [`files`]: how every program opens and makes files in a run's folder.

#![deny(unsafe_code)]

#[cfg(test)]
extern crate self as quad_run;

pub mod config;
pub mod files;
#[cfg(test)]
mod fixtures;
pub mod folder;
pub mod results;
pub mod status;
pub mod table;
