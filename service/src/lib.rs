//! What the learner and the evaluator have in common as long-running programs.
//!
//! # Layout
//!
//! In reading order, which is the order of a process's life:
//!
//! - `logging`: where log lines go.
//! - `session`: the connection between learner and evaluators, over Zenoh; `certificates`: who a program is there;
//!   `access`: what others may do.
//! - `metrics_server`: `/metrics` and `/healthz`.
//! - `shutdown`: the signals that end a process.
//! - `exit`: how an error is shown to the user, and the exit code.

mod access;
mod certificates;
mod exit;
mod logging;
mod metrics_server;
mod session;
mod shutdown;

pub use certificates::{Certificates, CertificatesError, Role};
pub use exit::{Hint, run_main};
pub use logging::init_logging;
pub use metrics_server::{BindError, MetricsServer, serve_metrics};
pub use session::{Endpoints, SessionError, default_endpoint, open_session, parse_endpoint, reachable_at};
pub use shutdown::shutdown_signal;
