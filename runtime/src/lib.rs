//! Services that learner and evaluator share.
//!
//! # Layout
//!
//! In reading order, from the start of a process to its end: `logging`; `endpoints`, `certificates` and
//! `session`, the connection over Zenoh; `threads`, limits on processor time; `health` and
//! `metrics_server`; `shutdown`, the signals; `exit`, errors and exit codes; `progress_bar`;
//! [`doctor`], checks of a machine.

mod certificates;
pub mod doctor;
mod endpoints;
mod exit;
mod health;
mod logging;
mod metrics_server;
mod progress_bar;
mod session;
mod shutdown;
mod threads;

pub use certificates::{Certificates, CertificatesError, Role, certificates_folder};
pub use endpoints::{DEFAULT_PORT, Endpoints, SessionError, default_endpoint, parse_endpoint};
pub use exit::{
    ENDED_AT_ONCE, FAILURE_FILE, Hint, UNFINISHED, clean, hinted, hints, json, one_line, print,
    run_main, unfinished,
};
pub use health::{Health, Heartbeat};
pub use logging::{Logging, init_logging};
pub use metrics_server::{ListenError, MetricsServer, parse_address, serve_metrics};
pub use progress_bar::ProgressBar;
pub use session::{open_router, open_session, reachable_at};
pub use shutdown::{LEAVE_WITHIN, shutdown_signal, unfinished_at_signal};
pub use threads::{choose_threads, requested_threads, stay_in_background};
