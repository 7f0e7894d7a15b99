//! Claims: which episodes an evaluator gets.

use std::ops::RangeBounds;
use std::time::{Duration, Instant};

use quad_protocol::{Job, JobReply, JobRequest, Name};

use super::Service;
use super::evaluation::{Evaluation, Key};
use super::open_job::OpenJob;

/// Time after which an evaluator without a job asks again: the larger of this time, and the second
/// one for each evaluator, so that hundreds of idle ones do not keep the learner busy. A new
/// snapshot wakes them all.
const ASK_AGAIN: [Duration; 2] = [Duration::from_millis(500), Duration::from_millis(100)];
/// [`ASK_AGAIN`] while there are online episodes to play, for which training may wait.
const ASK_FOR_ONLINE: [Duration; 2] = [Duration::from_millis(20); 2];
/// [`ASK_AGAIN`] between two online episodes: training comes to the next one when it has
/// learned from another, which may be short.
const ASK_BETWEEN: [Duration; 2] = [Duration::from_millis(100), Duration::from_millis(20)];
/// Time between an evaluator's progress messages, by the rule of [`ASK_AGAIN`].
const PROGRESS: [Duration; 2] = [Duration::from_secs(1), Duration::from_millis(40)];
/// Longest time between progress messages.
const LONGEST_PROGRESS: Duration = Duration::from_secs(20);
/// Time after which an evaluator without the run's environment asks again.
const DOES_NOT_FIT: Duration = Duration::from_secs(10);

/// An online episode for which training has waited for this time goes to a second evaluator: the
/// first answer counts.
const STRAGGLER: Duration = Duration::from_secs(20);

impl<Q> Service<Q> {
    /// Answers a claim or a hand-back.
    pub(super) fn job(&mut self, request: &JobRequest, now: Instant) -> JobReply {
        match request {
            JobRequest::Claim { evaluator, attempt, environments } => {
                let fits = environments.contains(&self.rules.task.environment);
                self.evaluators.asked(evaluator, fits);
                match fits {
                    true => self.claim(evaluator, *attempt, now),
                    false => self.wait(DOES_NOT_FIT),
                }
            }
            JobRequest::HandBack { evaluator, job, failed } => {
                let accepted = self.hand_back(evaluator, *job, failed.as_deref(), now);
                JobReply::HandedBack { incarnation: self.rules.incarnation, accepted }
            }
        }
    }

    fn wait(&self, time: Duration) -> JobReply {
        let milliseconds = time.as_millis() as u64;
        JobReply::Wait { incarnation: self.rules.incarnation, milliseconds }
    }

    /// Hands out a job: the next online episode, or waiting episodes of the oldest step. An
    /// evaluator has one job at a time; a repeated claim, after a lost answer, gets the same answer.
    fn claim(&mut self, evaluator: &Name, attempt: u64, now: Instant) -> JobReply {
        let often = match self.evaluations.first_key_value() {
            _ if self.trained || self.online.is_empty() => ASK_AGAIN,
            Some((Key::Online(_), _)) => ASK_FOR_ONLINE,
            _ => ASK_BETWEEN,
        };
        let wait = self.wait(self.interval(often));
        if let Some(open) = self.jobs.get_mut(evaluator) {
            if open.attempt == attempt {
                return JobReply::Job(open.job.clone());
            }
            open.asked_again = true;
            return wait;
        }
        let first = if self.trained { Key::FIRST_EVALUATION } else { Key::Online(0) };
        let handed_out = self
            .hand_out(first..Key::FIRST_EVALUATION, now)
            .or_else(|| self.straggler(now))
            .or_else(|| self.hand_out(Key::FIRST_EVALUATION.., now));
        let Some((key, seeds)) = handed_out else { return wait };
        let Evaluation { step, weights, exploration, .. } = &self.evaluations[&key];
        let progress = self.interval(PROGRESS);
        // One message may be lost, and the next one late.
        let patience = self.rules.lease.max(3 * progress.min(LONGEST_PROGRESS));
        let job = Job {
            id: self.next_job,
            run: self.rules.run.clone(),
            incarnation: self.rules.incarnation,
            step: *step,
            weights: *weights,
            environment: self.rules.task.environment.clone(),
            environment_seed: self.rules.seed,
            seeds,
            exploration: *exploration,
            // Often enough to keep the lease.
            progress_milliseconds: progress.min(patience / 3).as_millis() as u64,
        };
        self.next_job += 1;
        let open = OpenJob::new(job.clone(), key, attempt, patience, now);
        self.jobs.insert(evaluator.clone(), open);
        self.count_jobs("handed_out", 1);
        JobReply::Job(job)
    }

    /// Hands out the first waiting episodes in this range with the next job.
    fn hand_out(&mut self, keys: impl RangeBounds<Key>, now: Instant) -> Option<(Key, Vec<u64>)> {
        let limits = [self.rules.job_episodes[0], self.most_episodes()];
        self.evaluations.range_mut(keys).find_map(|(&key, evaluation)| {
            let seeds = evaluation.hand_out(self.next_job, limits, now);
            (!seeds.is_empty()).then_some((key, seeds))
        })
    }

    /// The online episode that training has waited for too long, if one evaluator plays it.
    fn straggler(&mut self, now: Instant) -> Option<(Key, Vec<u64>)> {
        let (episode, _) = self.awaited.filter(|(_, since)| now >= *since + STRAGGLER)?;
        let key = Key::Online(episode);
        let players = self.jobs.values().filter(|open| open.key == key).count();
        let evaluation = self.evaluations.get_mut(&key).filter(|_| players == 1)?;
        let seeds = evaluation.hand_out_again(self.next_job);
        // It may rest, because a second evaluator has failed.
        (!seeds.is_empty()).then_some((key, seeds))
    }

    /// Most episodes of a job: half of an evaluator's share of those that wait, so that none is
    /// idle in the end. Large jobs take fewer messages, and fewer evaluators that fetch the same
    /// weights.
    fn most_episodes(&self) -> usize {
        let evaluations = self.evaluations.range(Key::FIRST_EVALUATION..);
        let waiting: usize = evaluations.map(|(_, evaluation)| evaluation.waiting()).sum();
        let [least, most] = self.rules.job_episodes;
        (waiting / (2 * self.evaluators.count().max(1))).clamp(least, most)
    }

    /// Interval at which one of the evaluators may do something: `least`, or `each` times their
    /// number if that is longer.
    fn interval(&self, [least, each]: [Duration; 2]) -> Duration {
        least.max(each * u32::try_from(self.evaluators.count()).unwrap_or(u32::MAX))
    }
}
