//! Where log lines go, and how many of a kind.

use std::io::IsTerminal;

use tracing_subscriber::EnvFilter;

use crate::throttle::Throttled;

/// Without RUST_LOG: our own progress, and Zenoh's complaints (`zenoh` is the prefix of all of its crates), but for its
/// warning that scouting by gossip is off, which it is on purpose.
const DEFAULT_FILTER: &str = "info,zenoh=warn,zenoh::net::routing::hat::peer=error";

/// Sends log lines to stderr, coloured on a terminal; the environment variable RUST_LOG chooses which.
///
/// To be called once, first thing in `main`; further calls do nothing.
pub fn init_logging() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(DEFAULT_FILTER));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .map_event_format(Throttled::new)
        .try_init()
        .ok();
}
