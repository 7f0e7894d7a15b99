//! Evaluators that leave, are lost with their jobs, or cannot do them.

use std::time::Instant;

use quad_protocol::Name;
use tracing::{debug, warn};

use super::Hub;
use crate::notice::Notice;
use crate::scoreboard::Lost;

/// Of what an evaluator says about a job that it could not do, so much is passed on, in characters.
const LONGEST_REASON: usize = 300;

impl Hub {
    pub(super) fn left(&mut self, evaluator: Name) {
        if self.evaluators.remove(&evaluator) {
            let lost = self.scoreboard.evaluator_gone(&evaluator, Instant::now());
            self.evaluators.left(evaluator, lost.jobs);
            self.lost(lost);
        }
    }

    /// An evaluator could not do a job, which is told once for each step.
    pub(super) fn failed(&mut self, step: u64, evaluator: &Name, reason: &str) {
        self.metrics.evaluation.jobs_failed.inc();
        let reason: String = reason.chars().filter(|c| !c.is_control()).take(LONGEST_REASON).collect();
        debug!(step, %evaluator, reason, "a job failed");
        if self.failures_told.insert(step) {
            self.notices.send(Notice::JobFailed { step, evaluator: evaluator.clone(), reason }).ok();
        }
    }

    pub(super) fn lost(&mut self, lost: Lost) {
        self.metrics.evaluation.jobs_expired.inc_by(lost.jobs as u64);
        self.give_up(lost.given_up);
    }

    pub(super) fn give_up(&mut self, episodes: Vec<(u64, u64)>) {
        if episodes.is_empty() {
            return;
        }
        for (step, seed) in &episodes {
            warn!(step, seed, "an episode is given up: too many evaluators were lost with it or could not do it");
        }
        self.notices.send(Notice::GivenUp(episodes)).ok();
        self.settle();
    }
}
