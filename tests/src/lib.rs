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
//! - [`router`]: a Zenoh router in the test's own process; [`certificates`]: one for each role, and
//!   sessions that show them.
//! - [`made_up`]: messages that tests make up; [`crowd`]: hundreds of evaluators that only talk.
//! - [`link`]: a connection on which things go wrong.
//! - [`power`]: what a disk holds after a power cut; [`small_disk`]: one that is soon full;
//!   [`hanging_disk`]: one that hangs.
//! - [`peers`]: programs that are not ours; where one is missing, a test is skipped or fails.
//! - [`prometheus`]: one to start and ask; [`dashboard`]: what Grafana's panels ask it.
//!
//! A helper that cannot do its work panics, and so fails its test.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

pub mod certificates;
pub mod crowd;
pub mod dashboard;
pub mod hanging_disk;
pub mod http;
pub mod learner;
pub mod link;
pub mod made_up;
pub mod peers;
pub mod power;
pub mod process;
pub mod prometheus;
pub mod router;
pub mod setting;
pub mod small_disk;
pub mod system;

use std::time::{Duration, Instant};

/// Longest wait for anything: far more than needed, unless the machine is busy.
pub const PATIENCE: Duration = Duration::from_secs(300);

/// Polls until `condition` gives something; panics after `patience`.
pub fn eventually<T>(
    what: &str,
    patience: Duration,
    mut condition: impl FnMut() -> Option<T>,
) -> T {
    let deadline = Instant::now() + patience;
    loop {
        if let Some(value) = condition() {
            return value;
        }
        assert!(Instant::now() < deadline, "after {patience:?} still not: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Tries what a busy machine may keep from happening within a program's own time limits; panics if
/// it never happens.
pub fn in_some_try(what: &str, attempt: impl FnMut(usize) -> bool) {
    assert!((0..5).any(attempt), "not in five tries: {what}");
}

/// The size of a test, from an environment variable.
pub fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).map_or(default, |text| text.parse().expect("a number"))
}
