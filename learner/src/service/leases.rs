//! The lease of a job, which progress extends, and its end.

use std::time::Instant;

use quad_protocol::{Job, Name, Progress};
use quad_run::counted;

use super::Service;
use super::message::{Order, Refusal, require};
use super::open_job::OpenJob;

/// Most characters of an evaluator's error message that the learner logs.
const LONGEST_REASON: usize = 300;
/// Most evaluator names for which the learner reports that two evaluators use them.
const MOST_SHARED_NAMES: usize = 100;

impl<Q> Service<Q> {
    pub(super) fn progress(&mut self, progress: Progress, now: Instant) {
        let shares_name = match self.advance(&progress, now) {
            Ok(shares_name) => shares_name,
            Err(refusal) => return self.orders.push(Order::rejected(refusal)),
        };
        let (names, name) = (&mut self.told.shared_names, &progress.evaluator);
        if shares_name && names.len() < MOST_SHARED_NAMES && names.insert(name.clone()) {
            self.orders.push(Order::Tell(format!(
                "two evaluators were started with --name {name}, and one of them gets no work; give each its own name"
            )));
        }
        if self.evaluators.progress(name, now) {
            self.orders.push(Order::Show(progress));
        }
    }

    /// Extends the lease of the evaluator's job, if the job is further than before. Returns whether
    /// two evaluators share a name: one that is at a job does not ask for another.
    fn advance(&mut self, progress: &Progress, now: Instant) -> Result<bool, Refusal> {
        require(progress.run == self.rules.run, Refusal::Run)?;
        require(progress.incarnation == self.rules.incarnation, Refusal::Incarnation)?;
        let open = self.jobs.get_mut(&progress.evaluator);
        let open = open.filter(|open| open.job.id == progress.job).ok_or(Refusal::Job)?;
        open.advance(progress, now)?;
        Ok(open.asked_again)
    }

    /// Extends the lease of a job whose results have come but are not on the disk yet: its evaluator
    /// has done all that it can.
    pub(super) fn extend_lease(
        &mut self,
        evaluator: &Name,
        incarnation: u64,
        job: u64,
        now: Instant,
    ) {
        if let Some(open) = self.jobs.get_mut(evaluator)
            && incarnation == self.rules.incarnation
            && job == open.job.id
        {
            open.extend(now, Job::LONGEST);
        }
    }

    /// Ends the job of an evaluator, if it has one, which may be `lost` now. Its episodes wait for
    /// the next job, except those that are given up. Returns the job and their number.
    fn release(&mut self, evaluator: &Name, lost: Option<Instant>) -> Option<(Job, usize)> {
        let OpenJob { key, job, .. } = self.jobs.remove(evaluator)?;
        let evaluation = self.evaluations.get_mut(&key);
        let given_up = evaluation.map_or(0, |evaluation| evaluation.take_back(job.id, lost));
        Some((job, given_up))
    }

    /// Takes a job back from an evaluator that leaves, or has `failed` to do it, which counts as if
    /// it had been lost. False if the evaluator has no such job.
    pub(super) fn hand_back(
        &mut self,
        evaluator: &Name,
        id: u64,
        failed: Option<&str>,
        now: Instant,
    ) -> bool {
        let has_job = self.jobs.get(evaluator).is_some_and(|open| open.job.id == id);
        let released = has_job.then(|| self.release(evaluator, failed.map(|_| now)));
        let Some((job, given_up)) = released.flatten() else { return false };
        match failed {
            Some(reason) => self.tell_failed(&job, evaluator, reason, now),
            None => self.count_jobs("handed_back", 1),
        }
        self.tell_given_up(given_up);
        true
    }

    /// Tells of a job that an evaluator could not run, once for each step, and online, since
    /// training waits, each minute.
    fn tell_failed(&mut self, job: &Job, evaluator: &Name, reason: &str, now: Instant) {
        let (step, online) = (job.step, job.exploration.is_some());
        self.count_jobs("failed", 1);
        let minute = online.then(|| (now - self.begin).as_secs() / 60);
        if self.told.failed_steps.insert((step, minute)) {
            let printable = reason.chars().filter(|c| !c.is_control());
            let reason = String::from_iter(printable.take(LONGEST_REASON));
            let what = if online { "play online episodes" } else { "do a job" };
            self.tell(format!(
                "evaluator {evaluator} could not {what} of step {step}, which goes to others: {reason}"
            ));
        }
    }

    fn tell_given_up(&mut self, episodes: usize) {
        if episodes > 0 {
            let episodes = counted(episodes, "episode");
            self.tell(format!("{episodes} given up: too many evaluators were lost or failed"));
        }
    }

    /// Frees the job of an evaluator that has left.
    pub(super) fn left(&mut self, evaluator: Name, now: Instant) {
        let lost = self.release(&evaluator, Some(now));
        let (was_here, line) = self.evaluators.left(&evaluator, lost.is_some());
        self.orders.extend(line.map(Order::Tell));
        if let Some((_, given_up)) = lost {
            self.count_jobs("expired", 1);
            self.tell_given_up(given_up);
        }
        if was_here {
            self.orders.push(Order::Forget(evaluator));
        }
    }

    /// Takes back the jobs whose lease has run out.
    pub(super) fn expire(&mut self, now: Instant) {
        let expired = self.jobs.iter().filter(|(_, open)| open.lease_until <= now);
        let evaluators = Vec::from_iter(expired.map(|(evaluator, _)| evaluator.clone()));
        if evaluators.is_empty() {
            return;
        }
        let jobs = counted(evaluators.len(), "job");
        self.tell(format!("{jobs} made no progress; other evaluators get the episodes"));
        self.count_jobs("expired", evaluators.len());
        let lost = evaluators.iter().filter_map(|evaluator| self.release(evaluator, Some(now)));
        let given_up = lost.map(|(_, given_up)| given_up).sum();
        self.tell_given_up(given_up);
    }
}
