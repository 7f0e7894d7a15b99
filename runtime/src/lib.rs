//! What learner and evaluator share as long-running programs.
//!
//! # Layout
//!
//! In reading order, which follows a process from start to end:
//!
//! - `logging`: which log lines a program writes, and where to.
//! - `endpoints`: where learner and evaluators meet; `certificates`: how they show their roles;
//!   `access`: what each role may do; `session`: the connection over Zenoh; `router`: a meeting
//!   point of many learners on one machine.
//! - `threads`, `background`: limit the processor time that the network takes.
//! - `health`: whether the parts of a process still do their work.
//! - `metrics_server`: `/metrics` and `/healthz`.
//! - `shutdown`: the signals that end a process.
//! - `exit`: how a program shows a result or an error to the user, and its exit code.
//! - `progress_bar`: shows how far a task is.
//! - [`doctor`]: checks of a machine, before a run starts on it.

mod access;
mod background;
mod certificates;
pub mod doctor;
mod endpoints;
mod exit;
mod health;
mod logging;
mod metrics_server;
mod progress_bar;
mod router;
mod session;
mod shutdown;
mod threads;

pub use background::stay_in_background;
pub use certificates::{Certificates, CertificatesError, Role, certificates_folder};
pub use endpoints::{DEFAULT_PORT, Endpoints, SessionError, default_endpoint, parse_endpoint};
pub use exit::{
    ENDED_AT_ONCE, Hint, UNFINISHED, clean, error_in, hinted, hints, json, print, run_main,
    unfinished,
};
pub use health::{Beat, Health};
pub use logging::{Logging, init_logging};
pub use metrics_server::{MetricsServer, serve_metrics};
pub use progress_bar::ProgressBar;
pub use router::open_router;
pub use session::{open_session, reachable_at};
pub use shutdown::{LEAVE_WITHIN, shutdown_signal};
pub use threads::{choose_threads, threads_asked};
