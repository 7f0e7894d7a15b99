//! A job that an evaluator has, and for how long it may keep it.

use std::time::{Duration, Instant};

use quad_protocol::{Job, Lease, Name, Progress};

use super::refusal::{Refusal, require};

/// Longest time until the first environment step, in which an evaluator fetches the weights.
const PREPARATION: Duration = Duration::from_secs(60);

/// A job that is handed out. It is forgotten as soon as it ends, however it ends.
#[derive(Debug)]
pub(super) struct OpenJob {
    pub evaluator: Name,
    /// Of the claim that it was handed out for.
    pub attempt: u64,
    pub step: u64,
    pub seeds: Vec<u64>,
    pub lease: Lease,
    /// How long it may stay without progress.
    pub patience: Duration,
    handed_out: Instant,
    lease_until: Instant,
    /// Environment steps and episodes of the last accepted progress.
    done: (u64, u32),
}

impl OpenJob {
    /// One that is handed out now.
    pub fn new(
        evaluator: Name,
        attempt: u64,
        (step, seeds): (u64, Vec<u64>),
        patience: Duration,
        now: Instant,
    ) -> Self {
        let (lease, lease_until) = (Lease::random(), now + patience);
        Self { evaluator, attempt, step, seeds, lease, patience, handed_out: now, lease_until, done: (0, 0) }
    }

    /// Whether the evaluator has lost it.
    pub fn is_lost(&self, now: Instant) -> bool {
        self.lease_until <= now
    }

    /// Extends the lease, if this shows that its owner is further than before: a message that is played again does not. Before
    /// the first environment step there is nothing to be further with, but only a short time; and the whole job has a
    /// longest time, too.
    pub fn advance(&mut self, progress: &Progress, now: Instant) -> Result<(), Refusal> {
        require(progress.evaluator == self.evaluator, Refusal::Evaluator)?;
        require(progress.is_signed(&self.lease), Refusal::Proof)?;
        let (steps, episodes) = (progress.steps_done, progress.episodes_done);
        let begins = self.done == (0, 0) && steps == 0 && episodes == 0;
        require(begins || steps > self.done.0 || episodes > self.done.1, Refusal::NotAdvanced)?;
        self.done = (steps.max(self.done.0), episodes.max(self.done.1));
        self.extend(now, if begins { PREPARATION } else { Job::LONGEST });
        Ok(())
    }

    /// Extends the lease, until `longest` after the job was handed out.
    pub fn extend(&mut self, now: Instant, longest: Duration) {
        self.lease_until = self.lease_until.max((now + self.patience).min(self.handed_out + longest));
    }
}
