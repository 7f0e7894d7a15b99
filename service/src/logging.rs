//! Where log lines go, and how many of a kind.

use std::io::IsTerminal;

use tracing_appender::non_blocking::{NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::EnvFilter;

use crate::throttle::Throttled;

/// Without RUST_LOG: our own progress, and Zenoh's complaints (`zenoh` is the prefix of all of its crates), but for its
/// warning that scouting by gossip is off, which it is on purpose.
const DEFAULT_FILTER: &str = "info,zenoh=warn,zenoh::net::routing::hat::peer=error";

/// Lines that wait for a reader of stderr; later ones are left out.
const MOST_WAITING: usize = 10_000;

/// Writes log lines for as long as it lives. Dropped, it writes those that wait, unless nobody reads them for a second.
#[must_use]
pub struct Logging {
    _writer: WorkerGuard,
}

/// Sends log lines to stderr, coloured on a terminal; the environment variable RUST_LOG chooses which. Nobody waits for a
/// reader of them but a thread of their own.
///
/// To be called once, first thing in `main`; further calls do nothing.
pub fn init_logging() -> Logging {
    let writer = NonBlockingBuilder::default().buffered_lines_limit(MOST_WAITING).thread_name("log");
    let (lines, guard) = writer.finish(std::io::stderr());
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(DEFAULT_FILTER));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_writer(lines)
        .with_ansi(std::io::stderr().is_terminal())
        .map_event_format(Throttled::new)
        .try_init()
        .ok();
    Logging { _writer: guard }
}
