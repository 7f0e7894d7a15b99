//! A run at work: its threads, its main loop, and all its communication over Zenoh.
//!
//! The main loop ([`MainLoop`]) runs on the main thread: it reports events and decides when the run
//! is over. The other threads report to it alone, through one queue of [`Events`].
//! docs/architecture.md has a table of all threads. The module `command` starts a run; no module
//! below calls this one.
//!
//! In reading order:
//!
//! - `threads` starts (with `spawn`) and ends the threads, which report `events` to `main_loop`; `network`
//!   opens the session meanwhile and declares everything on it, and `duplicate` looks for another
//!   learner of the same name.
//! - `snapshots` is the thread that writes the output of training, and publishes snapshots through
//!   `weights`.
//! - `carrier` brings messages and time to the service, and does what it orders; `services` calls it
//!   on threads that may wait. `results` is the thread that writes scores and experience, of which
//!   `experience` is what the run has at the start. `requests` are queries that wait for their answer.
//! - `metrics` are for Prometheus; `disk` reports a disk that refuses writes; `display` is the
//!   terminal, `page_state` the state for the page.

mod carrier;
mod disk;
mod display;
mod duplicate;
mod events;
mod experience;
mod main_loop;
mod metrics;
mod network;
mod page_state;
mod requests;
mod results;
mod services;
mod snapshots;
mod spawn;
mod threads;
mod weights;

pub(crate) use display::Display;
pub(crate) use duplicate::Incarnation;
pub(crate) use events::Events;
pub(crate) use main_loop::{Ending, MainLoop};
pub(crate) use metrics::Metrics;
pub(crate) use network::{OpeningSession, open_network};
pub(crate) use page_state::PageState;
pub(crate) use threads::{Run, STUCK, Threads};
