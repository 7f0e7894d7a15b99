//! Helpers of the whole-system tests, which run the real `learner` and `evaluator` as processes.
//!
//! # Layout
//!
//! In reading order:
//!
//! - [`process`]: start a program, signal it, wait for it, read what it said.
//! - [`setting`]: how long a run is; [`system`]: a scratch folder with a tiny dataset, and what is
//!   started in it; [`learner`]: what a learner tells and leaves in its run's folder.
//! - [`http`]: fetch a page, read a metric.
//! - [`router`]: Zenoh routers in the test's own process; [`certificates`]: one for each role, and
//!   sessions that show them; [`made_up`]: messages that tests make up.
//! - [`disk`]: disks that are full, hang, or lose their power.
//! - [`peers`]: programs that are not ours; where one is missing, a test is skipped or fails.
//! - [`prometheus`]: one to start and ask, and what Grafana's panels ask it.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

pub mod certificates;
pub mod disk;
pub mod http;
pub mod learner;
pub mod made_up;
pub mod peers;
pub mod process;
pub mod prometheus;
pub mod router;
pub mod setting;
pub mod system;

use std::time::{Duration, Instant};

/// Longest wait for anything: far more than a busy machine needs. Only a failure takes as long.
pub const PATIENCE: Duration = Duration::from_secs(600);

/// Polls until `condition` gives something.
pub fn eventually<T>(what: &str, mut condition: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        if let Some(value) = condition() {
            return value;
        }
        assert!(Instant::now() < deadline, "after {PATIENCE:?} still not: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Polls until `condition` holds.
pub fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
    eventually(what, || condition().then_some(()));
}
