//! The learner: trains on a dataset, publishes snapshots, collects their scores, and keeps everything in the run's folder.
//!
//! # Layout
//! In reading order; each module may use those below it:
//!
//! - `cli` is the command line; [`command`] runs a command, up to its exit code.
//! - `sweep` runs many runs, each as a process.
//! - `service` is a run at work: threads, main loop, Zenoh.
//! - `page` shows runs in a browser.
//! - `report` summarises scores as tables and figures.
//! - [`train`] makes gradient steps.
//! - `run` is the folder of a run.
//! - `evaluation` tracks which episodes wait for a score, and which evaluator has which. It does no input or output.
//! - `data` finds or fetches the data that a run learns from; [`config`] has the settings of a run.
//! - [`algorithms`]: one file each, to be read beside its paper.

#![deny(unsafe_code)]

pub mod algorithms;
pub mod cli;
pub mod command;
pub mod config;
mod data;
mod evaluation;
mod page;
mod report;
mod run;
mod service;
mod sweep;
pub mod train;
