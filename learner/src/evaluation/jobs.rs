//! The jobs that evaluators have, and for how long they may keep them.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use quad_protocol::{Job, Name, Progress};

use super::refusal::{Refusal, require};

/// Longest time until the first environment step, in which an evaluator fetches the weights.
const PREPARATION: Duration = Duration::from_secs(60);

/// A job that is handed out. It is forgotten as soon as it ends, however it ends.
#[derive(Debug)]
pub(super) struct OpenJob {
    pub evaluator: Name,
    /// Number of the claim that it was handed out for.
    pub attempt: u64,
    pub step: u64,
    pub seeds: Vec<u64>,
    /// How long it may stay without progress.
    pub patience: Duration,
    /// Whether a claim for another job has come under its evaluator's name.
    pub asked_again: bool,
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
        let (lease_until, done) = (now + patience, (0, 0));
        Self {
            evaluator,
            attempt,
            step,
            seeds,
            patience,
            asked_again: false,
            handed_out: now,
            lease_until,
            done,
        }
    }

    /// Extends the lease, if the evaluator is further than before: one whose simulation hangs loses
    /// its job. Before the first environment step the lease is short; every job has a maximum time.
    pub fn advance(&mut self, progress: &Progress, now: Instant) -> Result<(), Refusal> {
        require(progress.evaluator == self.evaluator, Refusal::Evaluator)?;
        let (steps, episodes) = (progress.steps_done, progress.episodes_done);
        let begins = self.done == (0, 0) && steps == 0 && episodes == 0;
        require(begins || steps > self.done.0 || episodes > self.done.1, Refusal::NotAdvanced)?;
        self.done = (steps.max(self.done.0), episodes.max(self.done.1));
        self.extend(now, if begins { PREPARATION } else { Job::LONGEST });
        Ok(())
    }

    /// How many of its episodes have ended, as the evaluator says.
    pub fn episodes_done(&self) -> u32 {
        self.done.1
    }

    /// Extends the lease, until `longest` after the job was handed out.
    pub fn extend(&mut self, now: Instant, longest: Duration) {
        self.lease_until =
            self.lease_until.max((now + self.patience).min(self.handed_out + longest));
    }
}

/// The open jobs, by their number and by evaluator, which has one at a time.
#[derive(Debug, Default)]
pub(super) struct OpenJobs {
    jobs: BTreeMap<u64, OpenJob>,
    of: HashMap<Name, u64>,
}

impl OpenJobs {
    /// One that was handed out to an evaluator that had none.
    pub fn insert(&mut self, id: u64, job: OpenJob) {
        self.of.insert(job.evaluator.clone(), id);
        self.jobs.insert(id, job);
    }

    pub fn get(&self, id: u64) -> Option<&OpenJob> {
        self.jobs.get(&id)
    }

    pub fn get_mut(&mut self, id: u64) -> Option<&mut OpenJob> {
        self.jobs.get_mut(&id)
    }

    /// The one that an evaluator has.
    pub fn of(&self, evaluator: &Name) -> Option<(u64, &OpenJob)> {
        let id = *self.of.get(evaluator)?;
        Some((id, self.jobs.get(&id)?))
    }

    pub fn remove(&mut self, id: u64) -> Option<OpenJob> {
        let job = self.jobs.remove(&id)?;
        self.of.remove(&job.evaluator);
        Some(job)
    }

    /// Jobs whose lease has run out.
    pub fn expired(&self, now: Instant) -> Vec<u64> {
        self.jobs.iter().filter(|(_, job)| job.lease_until <= now).map(|(&id, _)| id).collect()
    }
}
