//! A job at work, and its lease.

use std::time::{Duration, Instant};

use quad_protocol::{Job, Progress};

use super::evaluation::Key;
use super::message::{Refusal, require};

/// Longest time until the first environment step, in which an evaluator fetches the weights.
const PREPARATION: Duration = Duration::from_secs(60);

/// A job that an evaluator has, and its lease.
#[derive(Debug)]
pub(super) struct OpenJob {
    pub job: Job,
    /// The evaluation, or the online episode, that it is a part of.
    pub key: Key,
    /// Number of the claim that it was handed out for.
    pub attempt: u64,
    /// True if a claim for another job has come under its evaluator's name.
    pub asked_again: bool,
    /// Longest time without progress.
    patience: Duration,
    handed_out: Instant,
    pub lease_until: Instant,
    /// Environment steps and episodes of the last accepted progress.
    done: (u64, u32),
}

impl OpenJob {
    pub fn new(job: Job, key: Key, attempt: u64, patience: Duration, now: Instant) -> Self {
        let (handed_out, lease_until) = (now, now + patience);
        let (asked_again, done) = (false, (0, 0));
        Self { job, key, attempt, asked_again, patience, handed_out, lease_until, done }
    }

    /// The job, and the number of its episodes that have ended.
    pub fn progress(&self) -> (&Job, u32) {
        (&self.job, self.done.1)
    }

    /// Extends the lease, if the evaluator is further than before: one whose simulation hangs loses
    /// its job. Before the first environment step the lease is short; every job has a maximum time.
    pub fn advance(&mut self, progress: &Progress, now: Instant) -> Result<(), Refusal> {
        let (steps, episodes) = (progress.steps_done, progress.episodes_done);
        let begins = self.done == (0, 0) && steps == 0 && episodes == 0;
        require(begins || steps > self.done.0 || episodes > self.done.1, Refusal::NotAdvanced)?;
        self.done = (steps.max(self.done.0), episodes.max(self.done.1));
        self.extend(now, if begins { PREPARATION } else { Job::LONGEST });
        Ok(())
    }

    /// Extends the lease, until `longest` after the job was handed out.
    pub fn extend(&mut self, now: Instant, longest: Duration) {
        let until = (now + self.patience).min(self.handed_out + longest);
        self.lease_until = self.lease_until.max(until);
    }
}
