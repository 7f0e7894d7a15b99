//! The learner: trains on a dataset, publishes snapshots, collects their scores, and keeps all of it in the run's folder.
//!
//! # Layout
//! In reading order:
//!
//! - [`cli`] is the command line; [`config`] the experiment that it describes, a preset with flags on top,
//!   validated once.
//! - `data` finds or fetches the data that a run learns from.
//! - [`command`] goes from the command line to the exit, [`resume`] takes up a run that was there, by its settings;
//!   [`conduct`] is the main loop in between.
//! - [`threads`] starts the threads that do the work: [`trainer`] and [`train`] (nothing but gradient steps, by an [`agent`] on a
//!   [`device`]), [`keeper`] (snapshots and checkpoints to the disk), [`publisher`] (publishes snapshots), [`hub`]
//!   (hands out jobs, takes scores in) and [`scribe`] (scores to the disk).
//! - [`agent`] runs one of the [`algorithms`], each a file to be read beside its paper, with an [`optimiser`] and the
//!   [`random`] numbers of its seed, on a thread pool that is kept awake (`pool`).
//! - [`scoreboard`] is the hub's state without any I/O.
//! - [`wire`] declares everything on Zenoh; its callbacks fill an [`inbox`], [`replies`] answers and a [`herald`] publishes, so
//!   that nobody else waits for a peer that does not read; [`notice`] is what threads tell the main loop.
//! - [`run_dir`] is the folder of a run, [`trouble`] what is told of a disk that takes nothing, [`metrics`] are for Prometheus, [`display`] shows progress on the terminal.
//! - [`doctor`] checks a machine before a run is trusted to it.
//! - `report` summarises the scores as tables and as a picture.

#![deny(unsafe_code)]

pub mod agent;
pub mod algorithms;
pub mod cli;
pub mod command;
pub mod conduct;
pub mod config;
mod data;
pub mod device;
pub mod display;
pub mod doctor;
pub mod herald;
pub mod hub;
pub mod inbox;
pub mod keeper;
pub mod metrics;
pub mod notice;
pub mod optimiser;
mod pool;
pub mod publisher;
pub mod random;
pub mod replies;
mod report;
pub mod resume;
mod run;
pub mod run_dir;
pub mod scoreboard;
pub mod scribe;
pub mod threads;
pub mod train;
pub mod trainer;
pub mod trouble;
pub mod wire;
