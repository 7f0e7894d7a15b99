//! The learner: trains on a dataset, publishes snapshots, collects their scores, and keeps all of it in the run's folder.
//!
//! # Layout
//! In reading order, each room over those below it:
//!
//! - `cli` is the command line, [`command`] goes from there to the exit.
//! - `sweep` does many runs, each as a process.
//! - `service` is a run at work: threads, main loop, Zenoh.
//! - `page` shows runs to a browser.
//! - `report` summarises scores as tables and as a picture.
//! - [`train`] makes gradient steps.
//! - `run` is the folder of a run.
//! - `evaluation` is what is to be scored and by which evaluator, without input or output.
//! - `data` finds or fetches the data that a run learns from; [`config`] says what was asked for.
//! - [`algorithms`]: each a file to be read beside its paper.

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
