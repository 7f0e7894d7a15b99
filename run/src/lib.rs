//! Runs on disk: settings, folders, results and progress.
//!
//! In reading order; each module may use those below it:
//!
//! - [`status`]: progress of runs, and a list of all runs.
//! - [`results`]: summaries of a run's scores, and published scores.
//! - [`folder`]: the files of a run.
//! - [`config`]: the settings of a run.
//! - [`table`]: tables as text, Markdown and LaTeX.
//! - [`files`]: opens and makes files in a run's folder, for all programs.

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

/// `1 run`, `2 runs`.
pub fn counted(number: usize, noun: &str) -> String {
    let plural = if number == 1 { "" } else { "s" };
    format!("{number} {noun}{plural}")
}
