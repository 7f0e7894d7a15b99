//! What becomes of a job that ends without its scores: its evaluator hands it back, or is lost.

use std::time::Instant;

use quad_protocol::{Job, Lease, Name, ScoreReport};

use super::Scoreboard;
use super::evaluation::Ended;
use super::job::OpenJob;

/// A job that its evaluator has handed back.
#[derive(Clone, Debug, PartialEq)]
pub struct HandedBack {
    /// Gradient step of its snapshot.
    pub step: u64,
    /// As in [`Lost`].
    pub given_up: Vec<(u64, u64)>,
}

/// Jobs that were taken back.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Lost {
    /// How many.
    pub jobs: usize,
    /// Step and seed of the episodes that are not handed out any more, because they were lost too often.
    pub given_up: Vec<(u64, u64)>,
}

impl Scoreboard {
    /// Takes a job back from an evaluator that will not do it; nothing if it did not have it. That it only leaves does not
    /// count; that it `failed` to do it at some time counts as much as if it had been lost.
    pub fn hand_back(
        &mut self,
        evaluator: &Name,
        id: u64,
        lease: &Lease,
        failed: Option<Instant>,
    ) -> Option<HandedBack> {
        let has = |job: &&OpenJob| job.evaluator == *evaluator && job.lease == *lease;
        let step = self.jobs.get(id).filter(has)?.step;
        let proven = self.proven.contains(evaluator);
        let ended = failed.map_or(Ended::HandedBack, |now| Ended::Failed { now, proven });
        Some(HandedBack { step, given_up: self.release(id, ended) })
    }

    /// Lets an evaluator keep its job whose scores came but could not be saved yet: it did all that it can.
    pub fn keep(&mut self, report: &ScoreReport, now: Instant) {
        let of_this_life = report.incarnation == self.rules.incarnation;
        let job = self.jobs.get_mut(report.job).filter(|job| of_this_life && job.evaluator == report.evaluator);
        if let Some(job) = job {
            job.extend(now, Job::LONGEST);
        }
    }

    /// Takes back the jobs whose lease has run out.
    pub fn expire(&mut self, now: Instant) -> Lost {
        self.take_back(self.jobs.lost(now), now)
    }

    /// Takes back the job of an evaluator that is gone.
    pub fn evaluator_gone(&mut self, evaluator: &Name, now: Instant) -> Lost {
        self.proven.remove(evaluator);
        self.take_back(self.jobs.of(evaluator).map(|(id, _)| id).into_iter().collect(), now)
    }

    fn take_back(&mut self, jobs: Vec<u64>, now: Instant) -> Lost {
        Lost {
            jobs: jobs.len(),
            given_up: jobs.into_iter().flat_map(|id| self.release(id, Ended::Lost(now))).collect(),
        }
    }

    /// Ends a job, and lets its episodes wait for the next one; gives those that were lost too often.
    fn release(&mut self, id: u64, ended: Ended) -> Vec<(u64, u64)> {
        self.audits.release(id, ended);
        let Some(OpenJob { step, seeds, .. }) = self.jobs.remove(id) else { return Vec::new() };
        let given_up = self.evaluations.get_mut(&step).map(|evaluation| evaluation.take_back(id, &seeds, ended));
        given_up.unwrap_or_default().into_iter().map(|seed| (step, seed)).collect()
    }
}
