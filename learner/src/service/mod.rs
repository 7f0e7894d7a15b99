//! A run at work: its threads, its main loop, and everything that it says and hears on Zenoh.
//!
//! The main loop ([`MainLoop`]) runs on the main thread: it shows what happens and decides when the run is over. It alone is
//! told by the others, through one queue of [`events`](Event). The table of all threads is in docs/architecture.md. The
//! room `command` starts a run, and nothing below calls this room.
//!
//! In reading order:
//!
//! - `threads` starts (by `spawn`) and ends the threads; `events` is what they tell the main loop, `main_loop`; `network` gets the run
//!   online meanwhile, `duplicate` looks for another learner of the same name.
//! - `snapshots` is the thread that writes what training makes and publishes it by `weights`.
//! - `wire` declares everything on Zenoh, `services` says which thread answers what: a `pool`, or the thread `scores`, which
//!   writes scores down. A query until it is answered is one of the `requests`.
//! - `coordinator` is the state that they share: the scoreboard and the `evaluators`. `rejection` says why a message is not
//!   accepted.
//! - `metrics` are for Prometheus, `tensorboard` is the thread that copies the run to an event file, `disk` is what is told of a
//!   disk that refuses something, `display` what a person sees on a terminal, `live` what the page shows.

mod coordinator;
mod disk;
mod display;
mod duplicate;
mod evaluators;
mod events;
mod live;
mod local_evaluators;
mod main_loop;
mod metrics;
mod network;
mod patience;
mod pool;
mod rejection;
mod requests;
mod scores;
mod services;
mod snapshots;
mod spawn;
mod tensorboard;
#[cfg(test)]
#[path = "../../tests/unit/service/mod.rs"]
mod tests;
mod threads;
mod weights;
mod wire;

pub(crate) use display::Display;
pub(crate) use duplicate::Life;
pub(crate) use live::Live;
pub(crate) use local_evaluators::{LocalEvaluators, not_encrypted, spawn_logged};
pub(crate) use main_loop::{Ending, MainLoop};
pub(crate) use metrics::Metrics;
pub(crate) use network::{Opening, open_network};
pub(crate) use threads::{Run, STUCK, Threads};
