//! The state of all evaluations, without any I/O: which episodes wait, which are handed out and to whom, and the scores.
//!
//! An evaluation is a snapshot (step and hash) with a list of episode seeds. Jobs hand out some of its episodes under a
//! lease that progress extends; when the lease runs out or the evaluator leaves, they are handed out again, unless that has
//! happened too often. For each (step, seed) the first score that is delivered counts, and no other, whoever delivers it. The
//! current time is an argument, for tests. `job` has the rules of a lease, `jobs` who has which,
//! `ending` what becomes of a job that is not done, `screen` which reports are accepted, `refusal` why a message is not.

mod audit;
mod ending;
mod evaluation;
mod job;
mod jobs;
mod refusal;
mod screen;

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use quad_dataset::Task;
use quad_protocol::{EpisodeScore, Hash, Job, JobReply, Name, Progress, ScoreReport};

pub use audit::Audited;
use audit::Audits;
pub use ending::{HandedBack, Lost};
use evaluation::Evaluation;
use job::OpenJob;
use jobs::OpenJobs;
pub use refusal::Refusal;
use refusal::require;
pub use screen::Screened;

use crate::resume::Earlier;

/// After this time an evaluator asks again when there was no job for it, or after this time for each evaluator that there is
/// if that is longer, so that hundreds which have nothing to do do not keep the learner busy. A new snapshot wakes them all.
const ASK_AGAIN: [Duration; 2] = [Duration::from_millis(500), Duration::from_millis(100)];
/// The same for how often progress is told.
const TELL_PROGRESS: [Duration; 2] = [Duration::from_secs(1), Duration::from_millis(40)];
/// Progress is told at least this often.
const RARELY: Duration = Duration::from_secs(20);
/// After this time an evaluator asks again that does not have the run's environment.
const NOT_FOR_YOU: Duration = Duration::from_secs(10);

/// What stays the same for all evaluations of a run.
#[derive(Clone, Debug)]
pub struct Rules {
    /// The run.
    pub run: Name,
    /// Which start of the learner this is.
    pub incarnation: u64,
    /// Where policies are evaluated.
    pub task: Task,
    /// Seed of what the environment draws once for the whole run.
    pub instance: u64,
    /// Actions sampled per state.
    pub candidates: u32,
    /// Most episodes in one job: while as many evaluators as there are could share them, and if many more wait.
    pub job_episodes: [usize; 2],
    /// How long a job may stay without progress. Longer, if there are so many evaluators that they tell it rarely.
    pub lease: Duration,
    /// Share of the episodes that are scored a second time, 0 to 1.
    pub audit: f64,
}

/// The state of all evaluations of a run.
#[derive(Debug)]
pub struct Scoreboard {
    rules: Rules,
    evaluations: BTreeMap<u64, Evaluation>,
    jobs: OpenJobs,
    next_job: u64,
    /// Scores of an earlier life, by step, whose evaluation has not been asked for in this one.
    earlier: BTreeMap<u64, Earlier>,
    audits: Audits,
    /// Evaluators that have scored something since they came.
    proven: BTreeSet<Name>,
}

/// Training has come by a step again, and its weights are not those that were scored.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the weights of step {step} are {found}, but {scored} were scored before")]
pub struct OtherWeights {
    /// The step.
    pub step: u64,
    /// Hash of the weights as they are now.
    pub found: Hash,
    /// Hash of those that have scores.
    pub scored: String,
}

/// What a report completed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Recorded {
    /// Jobs that have no episode left to score: the report's, or another's that came too late.
    pub jobs_completed: usize,
    /// All episodes of its evaluation are scored: their scores.
    pub evaluation_completed: Option<Vec<EpisodeScore>>,
    /// Episodes that were scored a second time.
    pub audited: Vec<Audited>,
}

/// Who wants a job: the fields of a claim, and how many others may.
#[derive(Clone, Copy, Debug)]
pub struct Claim<'a> {
    /// Its name.
    pub evaluator: &'a Name,
    /// The same number, if it asks the same again.
    pub attempt: u64,
    /// The environments that it has.
    pub environments: &'a [String],
    /// The arithmetic that it computes in.
    pub precision: &'a Name,
    /// How many evaluators there are.
    pub present: usize,
}

impl Scoreboard {
    /// An empty one.
    pub fn new(rules: Rules) -> Self {
        let audits = Audits::new(rules.audit);
        let (evaluations, jobs, earlier) = (BTreeMap::new(), OpenJobs::default(), BTreeMap::new());
        Self { rules, evaluations, jobs, next_job: 1, earlier, audits, proven: BTreeSet::new() }
    }

    /// Which start of the learner this is.
    pub fn incarnation(&self) -> u64 {
        self.rules.incarnation
    }

    /// How many jobs were handed out so far.
    pub fn handed_out(&self) -> u64 {
        self.next_job - 1
    }

    /// Takes over the scores of an earlier life. They count as soon as the evaluation of their step is asked for.
    pub fn remember(&mut self, earlier: BTreeMap<u64, Earlier>) {
        self.earlier = earlier;
    }

    /// Asks for an evaluation of the snapshot of `step`. A step that is known already stays as it is. Gives the scores if
    /// an earlier life has completed it.
    ///
    /// # Errors
    /// The step is known with other weights.
    pub fn add_evaluation(
        &mut self,
        step: u64,
        weights: Hash,
        seeds: &[u64],
    ) -> Result<Option<Vec<EpisodeScore>>, OtherWeights> {
        let earlier = self.earlier.get(&step);
        let known = self.evaluations.get(&step).map(|evaluation| evaluation.weights.to_string());
        let scored = known.clone().or_else(|| earlier.map(|earlier| earlier.weights.clone()));
        if let Some(scored) = scored.filter(|scored| *scored != weights.to_string()) {
            return Err(OtherWeights { step, found: weights, scored });
        }
        if known.is_some() {
            return Ok(None);
        }
        let (scores, unchecked) = match self.earlier.remove(&step) {
            Some(Earlier { episodes, unchecked, .. }) => (episodes, unchecked),
            None => Default::default(),
        };
        unchecked.into_iter().for_each(|unchecked| self.audits.add_one(step, unchecked));
        let evaluation = Evaluation::new(weights, seeds, &scores);
        let complete = evaluation.scores();
        self.evaluations.insert(step, evaluation);
        Ok(complete)
    }

    /// Episodes that have no score yet, and may still get one: without those that are [`missing`](Self::missing).
    pub fn pending(&self) -> usize {
        self.evaluations.values().map(Evaluation::pending).sum()
    }

    /// Episodes that are to be scored a second time: how many wait for somebody who can do so, and how many are handed out.
    pub fn audits(&self) -> [usize; 2] {
        self.audits.count()
    }

    /// Episodes that were to be scored a second time and are not handed out for it any more.
    pub fn audits_given_up(&self) -> u64 {
        self.audits.given_up()
    }

    /// Step and seed of the episodes that have no score and are not handed out any more.
    pub fn missing(&self) -> Vec<(u64, u64)> {
        let of = |(&step, evaluation): (&u64, &Evaluation)| -> Vec<_> {
            evaluation.given_up().map(|seed| (step, seed)).collect()
        };
        self.evaluations.iter().flat_map(of).collect()
    }

    /// Hands out a job: episodes that are to be scored again, or else waiting ones of the oldest step. An evaluator has one
    /// job at a time; asked the same again, because the answer was lost, the answer is the same.
    pub fn claim(&mut self, claim: Claim<'_>, now: Instant) -> JobReply {
        let incarnation = self.rules.incarnation;
        let wait = |time: Duration| JobReply::Wait { incarnation, milliseconds: time.as_millis() as u64 };
        let later = wait(among(claim.present, ASK_AGAIN));
        if !claim.environments.contains(&self.rules.task.environment) {
            return wait(NOT_FOR_YOU);
        }
        if let Some((id, job)) = self.jobs.of(claim.evaluator) {
            return match job.attempt == claim.attempt {
                true => self.message(id, job, claim.present).map_or(later, JobReply::Job),
                false => later,
            };
        }
        let id = self.next_job;
        let most = self.job_episodes(claim.present);
        let audit = self.audits.hand_out(id, claim.evaluator, claim.precision, most);
        let proven = self.proven.contains(claim.evaluator);
        let Some(episodes) = audit.or_else(|| self.hand_out(id, most, proven, now)) else { return later };
        let job = OpenJob::new(claim.evaluator.clone(), claim.attempt, episodes, self.lease(claim.present), now);
        let message = self.message(id, &job, claim.present);
        self.jobs.insert(id, job);
        self.next_job += 1;
        message.map_or(later, JobReply::Job)
    }

    /// Most episodes of a job: half of an evaluator's share of those that wait, so that none is idle in the end. Large jobs
    /// take fewer messages, and fewer evaluators that fetch the same weights.
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
    fn hand_out(&mut self, job: u64, most: usize, proven: bool, now: Instant) -> Option<(u64, Vec<u64>)> {
        let few = self.rules.job_episodes[0];
        self.evaluations.iter_mut().find_map(|(&step, evaluation)| {
            let seeds = evaluation.hand_out(job, [few, most], proven, now);
            (!seeds.is_empty()).then_some((step, seeds))
        })
    }

    /// The job as it is handed out, to one of several evaluators.
    fn message(&self, id: u64, job: &OpenJob, present: usize) -> Option<Job> {
        let rules = &self.rules;
        Some(Job {
            id,
            lease: job.lease.clone(),
            run: rules.run.clone(),
            incarnation: rules.incarnation,
            step: job.step,
            weights: self.evaluations.get(&job.step)?.weights,
            environment: rules.task.environment.clone(),
            instance: rules.instance,
            seeds: job.seeds.clone(),
            candidates: rules.candidates,
            // Often enough to keep the lease.
            progress_milliseconds: among(present, TELL_PROGRESS).min(job.patience / 3).as_millis() as u64,
        })
    }

    /// Extends the lease of the job that an evaluator is at, if the job is further than before.
    pub fn progress(&mut self, progress: &Progress, now: Instant) -> Result<(), Refusal> {
        require(progress.run == self.rules.run, Refusal::Run)?;
        require(progress.incarnation == self.rules.incarnation, Refusal::Incarnation)?;
        let job = self.jobs.get_mut(progress.job).ok_or(Refusal::Job)?;
        job.advance(progress, now)
    }

    /// Counts the new scores of a report that [`screen`](Self::screen) let pass.
    pub fn record(&mut self, report: &ScoreReport, new: &[EpisodeScore]) -> Recorded {
        let Some(evaluation) = self.evaluations.get_mut(&report.step) else { return Recorded::default() };
        // The report's own job, and others that had some of its episodes because it came late.
        let mut jobs = evaluation.score(new);
        let (audited, checked) = self.audits.compare(report);
        jobs.extend(checked);
        self.audits.add(report, new);
        if !new.is_empty() {
            self.proven.insert(report.evaluator.clone());
        }
        let (audits, open) = (&self.audits, &mut self.jobs);
        let done = |seed| evaluation.is_scored(seed) == Some(true);
        jobs.retain(|&id| {
            let complete = open.get(id).is_some_and(|job| job.seeds.iter().copied().all(done)) && !audits.is_open(id);
            complete && open.remove(id).is_some()
        });
        let evaluation_completed = if new.is_empty() { None } else { evaluation.scores() };
        Recorded { jobs_completed: jobs.len(), evaluation_completed, audited }
    }
}

/// How often one of `present` evaluators does something: at least this often, and no more often than all of them may.
fn among(present: usize, [least, for_each]: [Duration; 2]) -> Duration {
    least.max(for_each * u32::try_from(present).unwrap_or(u32::MAX))
}
