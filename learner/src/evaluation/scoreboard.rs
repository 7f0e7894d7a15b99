//! All evaluations of a run.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use quad_dataset::Task;
use quad_protocol::{EpisodeScore, Hash, Job, Name, Progress, ScoreReport};
use quad_run::folder::SavedScores;

use super::episodes::Evaluation;
use super::jobs::{OpenJob, OpenJobs};
use super::outcomes::{Claim, Claimed, HandedBack, Lost, OtherWeights, Recorded};
use super::refusal::{Refusal, require};

/// After this time an evaluator asks again when there was no job for it, or after this time for
/// each evaluator that there is if that is longer, so that hundreds which have nothing to do do not
/// keep the learner busy. A new snapshot wakes them all.
const ASK_AGAIN: [Duration; 2] = [Duration::from_millis(500), Duration::from_millis(100)];
/// Time between an evaluator's progress messages, or this time for each evaluator if that is
/// longer.
const TELL_PROGRESS: [Duration; 2] = [Duration::from_secs(1), Duration::from_millis(40)];
/// Progress is told at least this often.
const RARELY: Duration = Duration::from_secs(20);
/// After this time an evaluator asks again that does not have the run's environment.
const NOT_FOR_YOU: Duration = Duration::from_secs(10);

/// What stays the same for all evaluations of a run.
#[derive(Clone, Debug)]
pub(crate) struct Rules {
    pub run: Name,
    /// Which start of the learner this is.
    pub incarnation: u64,
    /// Where policies are evaluated.
    pub task: Task,
    /// Seed of what the environment draws once for the whole run.
    pub environment_seed: u64,
    /// Most episodes in one job: while as many evaluators as there are could share them, and if
    /// many more wait.
    pub job_episodes: [usize; 2],
    /// How long a job may stay without progress. Longer, if there are so many evaluators that they
    /// tell it rarely.
    pub lease: Duration,
}

/// The state of all evaluations of a run.
#[derive(Debug)]
pub(crate) struct Scoreboard {
    pub(super) rules: Rules,
    pub(super) evaluations: BTreeMap<u64, Evaluation>,
    jobs: OpenJobs,
    next_job: u64,
    /// Scores of an earlier incarnation, by step, whose evaluation has not been asked for in this
    /// one.
    earlier: BTreeMap<u64, SavedScores>,
}

impl Scoreboard {
    /// Without evaluations. The scores of an `earlier` incarnation count as soon as the evaluation
    /// of their step is asked for.
    pub fn new(rules: Rules, earlier: BTreeMap<u64, SavedScores>) -> Self {
        Self {
            rules,
            evaluations: BTreeMap::new(),
            jobs: OpenJobs::default(),
            next_job: 1,
            earlier,
        }
    }

    /// Asks for an evaluation of the snapshot of `step`. A step that is known already stays as it
    /// is. Gives the scores if an earlier incarnation has completed it.
    ///
    /// # Errors
    /// The step is known with other weights.
    pub fn add_evaluation(
        &mut self,
        step: u64,
        weights: Hash,
        seeds: &[u64],
    ) -> Result<Option<Vec<EpisodeScore>>, OtherWeights> {
        let known = self.evaluations.get(&step).map(|evaluation| evaluation.weights.to_string());
        let scored = known
            .clone()
            .or_else(|| self.earlier.get(&step).map(|earlier| earlier.weights.clone()));
        if let Some(scored) = scored.filter(|scored| *scored != weights.to_string()) {
            return Err(OtherWeights { step, found: weights, scored });
        }
        if known.is_some() {
            return Ok(None);
        }
        let scores = self.earlier.remove(&step).map(|earlier| earlier.episodes).unwrap_or_default();
        let evaluation = Evaluation::new(weights, seeds, &scores);
        let complete = evaluation.scores();
        self.evaluations.insert(step, evaluation);
        Ok(complete)
    }

    /// Hash of the snapshot of a step that is evaluated.
    pub fn weights(&self, step: u64) -> Option<Hash> {
        self.evaluations.get(&step).map(|evaluation| evaluation.weights)
    }

    /// Episodes that have no score yet, and may still get one: without those that are
    /// [`missing`](Self::missing).
    pub fn pending(&self) -> usize {
        self.evaluations.values().map(Evaluation::pending).sum()
    }

    /// Evaluations of which episodes are pending.
    pub fn evaluations_pending(&self) -> usize {
        self.evaluations.values().filter(|evaluation| evaluation.pending() > 0).count()
    }

    /// Step and seed of the episodes that have no score and are not handed out any more.
    pub fn missing(&self) -> Vec<(u64, u64)> {
        let of = |(&step, evaluation): (&u64, &Evaluation)| -> Vec<_> {
            evaluation.given_up().map(|seed| (step, seed)).collect()
        };
        self.evaluations.iter().flat_map(of).collect()
    }

    /// Hands out a job: waiting episodes of the oldest step. An evaluator has one job at a time;
    /// asked the same again, because the answer was lost, the answer is the same.
    pub fn claim(&mut self, claim: Claim<'_>, now: Instant) -> Claimed {
        let wait = Claimed::Wait(among(claim.present, ASK_AGAIN));
        if !claim.environments.contains(&self.rules.task.environment) {
            return Claimed::Wait(NOT_FOR_YOU);
        }
        if let Some((id, job)) = self.jobs.of(claim.evaluator) {
            let same = (job.attempt == claim.attempt)
                .then(|| self.message(id, job, claim.present))
                .flatten();
            let Some(job) = same else {
                self.jobs.get_mut(id).into_iter().for_each(|job| job.asked_again = true);
                return wait;
            };
            return Claimed::Job { job, again: true };
        }
        let (id, most) = (self.next_job, self.job_episodes(claim.present));
        let Some(episodes) = self.hand_out(id, most, now) else { return wait };
        let job = OpenJob::new(
            claim.evaluator.clone(),
            claim.attempt,
            episodes,
            self.lease(claim.present),
            now,
        );
        let message = self.message(id, &job, claim.present);
        self.jobs.insert(id, job);
        self.next_job += 1;
        message.map_or(wait, |job| Claimed::Job { job, again: false })
    }

    /// Most episodes of a job: half of an evaluator's share of those that wait, so that none is
    /// idle in the end. Large jobs take fewer messages, and fewer evaluators that fetch the same
    /// weights.
    fn job_episodes(&self, present: usize) -> usize {
        let waiting: usize = self.evaluations.values().map(Evaluation::waiting).sum();
        let [least, most] = self.rules.job_episodes;
        (waiting / (2 * present.max(1))).clamp(least, most)
    }

    /// How long a job may stay without progress: one message may be lost, and the next one late.
    fn lease(&self, present: usize) -> Duration {
        self.rules.lease.max(3 * among(present, TELL_PROGRESS).min(RARELY))
    }

    /// Waiting episodes of the oldest step that has any.
    fn hand_out(&mut self, job: u64, most: usize, now: Instant) -> Option<(u64, Vec<u64>)> {
        let few = self.rules.job_episodes[0];
        self.evaluations.iter_mut().find_map(|(&step, evaluation)| {
            let seeds = evaluation.hand_out(job, [few, most], now);
            (!seeds.is_empty()).then_some((step, seeds))
        })
    }

    /// The job as it is handed out, to one of several evaluators.
    fn message(&self, id: u64, job: &OpenJob, present: usize) -> Option<Job> {
        let rules = &self.rules;
        Some(Job {
            id,
            run: rules.run.clone(),
            incarnation: rules.incarnation,
            step: job.step,
            weights: self.evaluations.get(&job.step)?.weights,
            environment: rules.task.environment.clone(),
            environment_seed: rules.environment_seed,
            seeds: job.seeds.clone(),
            // Often enough to keep the lease.
            progress_milliseconds: among(present, TELL_PROGRESS).min(job.patience / 3).as_millis()
                as u64,
        })
    }

    /// The job that an evaluator has: its step, how many of its episodes have ended, and how many
    /// there are.
    pub fn job_of(&self, evaluator: &Name) -> Option<(u64, u32, usize)> {
        self.jobs.of(evaluator).map(|(_, job)| (job.step, job.episodes_done(), job.seeds.len()))
    }

    /// Extends the lease of the job that an evaluator is at, if the job is further than before.
    /// Gives whether two evaluators have one name: an evaluator that is at a job asks for no other,
    /// and one that asks is at none.
    pub fn progress(&mut self, progress: &Progress, now: Instant) -> Result<bool, Refusal> {
        require(progress.run == self.rules.run, Refusal::Run)?;
        require(progress.incarnation == self.rules.incarnation, Refusal::Incarnation)?;
        let job = self.jobs.get_mut(progress.job).ok_or(Refusal::Job)?;
        job.advance(progress, now)?;
        Ok(job.asked_again)
    }

    /// Counts the new scores of a report that [`validate`](Self::validate) let pass.
    pub fn record(&mut self, report: &ScoreReport, new: &[EpisodeScore]) -> Recorded {
        let Some(evaluation) = self.evaluations.get_mut(&report.step) else {
            return Recorded::default();
        };
        // The report's own job, and others that had some of its episodes because it came late.
        let mut jobs = evaluation.score(new);
        let open = &mut self.jobs;
        let done = |seed| evaluation.is_scored(seed) == Some(true);
        jobs.retain(|&id| {
            let complete = open.get(id).is_some_and(|job| job.seeds.iter().copied().all(done));
            complete && open.remove(id).is_some()
        });
        let evaluation_completed = if new.is_empty() { None } else { evaluation.scores() };
        Recorded { jobs_completed: jobs.len(), evaluation_completed }
    }

    /// Lets an evaluator keep its job whose scores have come but are not on the disk yet: it did
    /// all that it can.
    pub fn keep(&mut self, report: &ScoreReport, now: Instant) {
        let of_this_life = report.incarnation == self.rules.incarnation;
        let job = self
            .jobs
            .get_mut(report.job)
            .filter(|job| of_this_life && job.evaluator == report.evaluator);
        if let Some(job) = job {
            job.extend(now, Job::LONGEST);
        }
    }

    /// Takes a job back from an evaluator that will not do it; nothing if it did not have it. That
    /// it only leaves does not count; that it `failed` to do it at some time counts as much as if
    /// it had been lost.
    pub fn hand_back(
        &mut self,
        evaluator: &Name,
        id: u64,
        failed: Option<Instant>,
    ) -> Option<HandedBack> {
        let step = self.jobs.get(id).filter(|job| job.evaluator == *evaluator)?.step;
        Some(HandedBack { step, given_up: self.release(id, failed) })
    }

    /// Takes back the jobs whose lease has run out.
    pub fn expire(&mut self, now: Instant) -> Lost {
        self.take_back(self.jobs.expired(now), now)
    }

    /// Takes back the job of an evaluator that is gone.
    pub fn evaluator_gone(&mut self, evaluator: &Name, now: Instant) -> Lost {
        self.take_back(self.jobs.of(evaluator).map(|(id, _)| id).into_iter().collect(), now)
    }

    fn take_back(&mut self, jobs: Vec<u64>, now: Instant) -> Lost {
        Lost {
            jobs: jobs.len(),
            given_up: jobs.into_iter().flat_map(|id| self.release(id, Some(now))).collect(),
        }
    }

    /// Ends a job, and lets its episodes wait for the next one; gives those that were lost too
    /// often.
    fn release(&mut self, id: u64, lost: Option<Instant>) -> Vec<(u64, u64)> {
        let Some(OpenJob { step, seeds, .. }) = self.jobs.remove(id) else { return Vec::new() };
        let given_up = self
            .evaluations
            .get_mut(&step)
            .map(|evaluation| evaluation.take_back(id, &seeds, lost));
        given_up.unwrap_or_default().into_iter().map(|seed| (step, seed)).collect()
    }
}

/// How often one of `present` evaluators does something: at least this often, and no more often
/// than all of them may.
fn among(present: usize, [least, for_each]: [Duration; 2]) -> Duration {
    least.max(for_each * u32::try_from(present).unwrap_or(u32::MAX))
}
