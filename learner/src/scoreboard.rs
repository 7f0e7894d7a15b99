//! The state of all evaluations, without any I/O: which episodes wait, which are handed out and to whom, and the scores.
//!
//! An evaluation is a snapshot (step and hash) with a list of episode seeds. Jobs hand out some of its episodes under a
//! lease that progress extends; when the lease runs out or the evaluator leaves, they are handed out again. For each
//! (step, seed) the first score that is delivered counts, and no other. The current time is an argument, for tests.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use quad_dataset::Task;
use quad_protocol::{EpisodeScore, Hash, Job, JobReply, JobRequest, Name, Progress, ScoreReport};

use crate::resume::Earlier;

/// After this time an evaluator asks again when there was no job for it.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// The same for an evaluator that does not have the run's environment.
const NOT_FOR_YOU: Duration = Duration::from_secs(10);
/// Largest relative difference between a score and the one computed from its return; it allows for rounding only.
const SCORE_TOLERANCE: f64 = 1e-6;

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
    /// Most episodes in one job.
    pub job_episodes: usize,
    /// How long a job may stay without progress.
    pub lease: Duration,
}

/// The state of all evaluations of a run.
#[derive(Debug)]
pub struct Scoreboard {
    rules: Rules,
    evaluations: BTreeMap<u64, Evaluation>,
    jobs: BTreeMap<u64, JobRecord>,
    /// Scores of an earlier life, by step, whose evaluation has not been asked for in this one.
    earlier: BTreeMap<u64, Earlier>,
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

#[derive(Debug)]
struct Evaluation {
    weights: Hash,
    episodes: Vec<Episode>,
}

#[derive(Debug)]
struct Episode {
    seed: u64,
    state: EpisodeState,
}

#[derive(Debug)]
enum EpisodeState {
    Waiting,
    HandedOut { job: u64 },
    Scored(EpisodeScore),
}

/// A job that was handed out. Kept for the whole run, so that late and repeated reports can still be checked.
#[derive(Debug)]
struct JobRecord {
    evaluator: Name,
    step: u64,
    seeds: Vec<u64>,
    /// `None` once it is completed or its episodes were given back.
    lease_until: Option<Instant>,
}

/// A report that passed every check, split into new scores and scores that are recorded already.
#[derive(Clone, Debug, PartialEq)]
pub struct Screened {
    /// Episodes that had no score yet.
    pub new: Vec<EpisodeScore>,
    /// Number of episodes that had a score already.
    pub duplicates: u32,
}

/// What a report completed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Recorded {
    /// The report's job has no episode left to score.
    pub job_completed: bool,
    /// All episodes of its evaluation are scored: their scores.
    pub evaluation_completed: Option<Vec<EpisodeScore>>,
}

/// Why a message about a job is not accepted.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// For another run.
    #[error("it is for another run")]
    Run,
    /// From before the learner's restart.
    #[error("it is from another incarnation of the learner")]
    Incarnation,
    /// No such job was handed out.
    #[error("no such job was handed out")]
    Job,
    /// The job was handed out to somebody else.
    #[error("the job was handed out to another evaluator")]
    Evaluator,
    /// Not the step of the job.
    #[error("the job is about another step")]
    Step,
    /// Not the weights of the job.
    #[error("the job is about other weights")]
    Weights,
    /// An episode that the job does not contain, or the same one twice.
    #[error("seed {0} is not in the job, or twice in the report")]
    Seed(u64),
    /// An episode with values that no episode of the environment can have.
    #[error("the episode with seed {0} has an impossible length, return or score")]
    Episode(u64),
}

impl Refusal {
    /// The reason as a metric's label.
    pub fn label(&self) -> &'static str {
        match self {
            Self::Run => "unknown_run",
            Self::Incarnation => "unknown_incarnation",
            Self::Job => "unknown_job",
            Self::Evaluator => "wrong_evaluator",
            Self::Step => "unknown_step",
            Self::Weights => "unknown_weights",
            Self::Seed(_) => "unknown_seed",
            Self::Episode(_) => "impossible_episode",
        }
    }
}

impl Scoreboard {
    /// An empty one.
    pub fn new(rules: Rules) -> Self {
        Self { rules, evaluations: BTreeMap::new(), jobs: BTreeMap::new(), earlier: BTreeMap::new() }
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
        let scores = self.earlier.remove(&step).map(|earlier| earlier.episodes).unwrap_or_default();
        let episode = |&seed| {
            let score = scores.iter().find(|score| score.seed == seed);
            Episode { seed, state: score.map_or(EpisodeState::Waiting, |score| EpisodeState::Scored(*score)) }
        };
        let evaluation = Evaluation { weights, episodes: seeds.iter().map(episode).collect() };
        let complete = evaluation.scores();
        self.evaluations.insert(step, evaluation);
        Ok(complete)
    }

    /// Episodes that have no score yet.
    pub fn pending(&self) -> usize {
        let scored = |episode: &&Episode| !matches!(episode.state, EpisodeState::Scored(_));
        self.evaluations.values().map(|evaluation| evaluation.episodes.iter().filter(scored).count()).sum()
    }

    /// Hands out a job: waiting episodes of the oldest step that has any.
    pub fn claim(&mut self, request: &JobRequest, now: Instant) -> JobReply {
        let wait = |time: Duration| JobReply::Wait { milliseconds: time.as_millis() as u64 };
        let rules = &self.rules;
        if !request.environments.contains(&rules.task.environment) {
            return wait(NOT_FOR_YOU);
        }
        let id = self.jobs.keys().next_back().map_or(1, |newest| newest + 1);
        for (&step, evaluation) in &mut self.evaluations {
            let waiting = evaluation.episodes.iter_mut().filter(|e| matches!(e.state, EpisodeState::Waiting));
            let mut seeds = Vec::new();
            for episode in waiting.take(rules.job_episodes) {
                episode.state = EpisodeState::HandedOut { job: id };
                seeds.push(episode.seed);
            }
            if seeds.is_empty() {
                continue;
            }
            let lease_until = Some(now + rules.lease);
            let record = JobRecord { evaluator: request.evaluator.clone(), step, seeds: seeds.clone(), lease_until };
            self.jobs.insert(id, record);
            return JobReply::Job(Job {
                id,
                run: rules.run.clone(),
                incarnation: rules.incarnation,
                step,
                weights: evaluation.weights,
                environment: rules.task.environment.clone(),
                instance: rules.instance,
                seeds,
                candidates: rules.candidates,
                lease_milliseconds: rules.lease.as_millis() as u64,
            });
        }
        wait(ASK_AGAIN)
    }

    /// Extends the lease of the job that an evaluator is at.
    pub fn progress(&mut self, progress: &Progress, now: Instant) -> Result<(), Refusal> {
        require(progress.run == self.rules.run, Refusal::Run)?;
        let job = self.jobs.get_mut(&progress.job).ok_or(Refusal::Job)?;
        require(job.evaluator == progress.evaluator, Refusal::Evaluator)?;
        if job.lease_until.is_some() {
            job.lease_until = Some(now + self.rules.lease);
        }
        Ok(())
    }

    /// Checks a report against the job it answers, and says what in it is new. Changes nothing: the caller writes the
    /// new scores down first, then calls [`record`](Self::record).
    pub fn screen(&self, report: &ScoreReport) -> Result<Screened, Refusal> {
        require(report.run == self.rules.run, Refusal::Run)?;
        require(report.incarnation == self.rules.incarnation, Refusal::Incarnation)?;
        let job = self.jobs.get(&report.job).ok_or(Refusal::Job)?;
        require(job.evaluator == report.evaluator, Refusal::Evaluator)?;
        require(job.step == report.step, Refusal::Step)?;
        let evaluation = self.evaluations.get(&report.step).ok_or(Refusal::Step)?;
        require(evaluation.weights == report.weights, Refusal::Weights)?;
        let mut screened = Screened { new: Vec::new(), duplicates: 0 };
        for (index, score) in report.episodes.iter().enumerate() {
            let repeated = report.episodes[..index].iter().any(|earlier| earlier.seed == score.seed);
            require(job.seeds.contains(&score.seed) && !repeated, Refusal::Seed(score.seed))?;
            require(self.is_possible(score), Refusal::Episode(score.seed))?;
            match evaluation.episode(score.seed).map(|episode| &episode.state) {
                Some(EpisodeState::Scored(_)) => screened.duplicates += 1,
                Some(_) => screened.new.push(*score),
                None => return Err(Refusal::Seed(score.seed)),
            }
        }
        Ok(screened)
    }

    fn is_possible(&self, score: &EpisodeScore) -> bool {
        let task = &self.rules.task;
        let expected = task.score(score.episode_return);
        let longest = task.max_episode_steps().unwrap_or(usize::MAX);
        let length_fits = (1..=longest).contains(&(score.length as usize));
        length_fits
            && expected.is_finite()
            && (score.score - expected).abs() <= SCORE_TOLERANCE * expected.abs().max(1.0)
    }

    /// Counts the new scores of a report that [`screen`](Self::screen) let pass.
    pub fn record(&mut self, report: &ScoreReport, new: &[EpisodeScore]) -> Recorded {
        let (Some(evaluation), Some(job)) = (self.evaluations.get_mut(&report.step), self.jobs.get_mut(&report.job))
        else {
            return Recorded::default();
        };
        for score in new {
            if let Some(episode) = evaluation.episodes.iter_mut().find(|episode| episode.seed == score.seed) {
                episode.state = EpisodeState::Scored(*score);
            }
        }
        let done = |seed| evaluation.episode(seed).is_some_and(|e| matches!(e.state, EpisodeState::Scored(_)));
        let job_completed = job.lease_until.is_some() && job.seeds.iter().copied().all(done);
        if job_completed {
            job.lease_until = None;
        }
        let evaluation_completed = if new.is_empty() { None } else { evaluation.scores() };
        Recorded { job_completed, evaluation_completed }
    }

    /// Takes back the jobs whose lease has run out; says how many.
    pub fn expire(&mut self, now: Instant) -> usize {
        self.give_back(|job| job.lease_until.is_some_and(|until| until <= now))
    }

    /// Takes back the jobs of an evaluator that is gone; says how many.
    pub fn evaluator_gone(&mut self, evaluator: &Name) -> usize {
        self.give_back(|job| job.lease_until.is_some() && job.evaluator == *evaluator)
    }

    fn give_back(&mut self, lost: impl Fn(&JobRecord) -> bool) -> usize {
        let mut count = 0;
        for (&id, job) in self.jobs.iter_mut().filter(|(_, job)| lost(job)) {
            count += 1;
            job.lease_until = None;
            let Some(evaluation) = self.evaluations.get_mut(&job.step) else { continue };
            for episode in &mut evaluation.episodes {
                if matches!(episode.state, EpisodeState::HandedOut { job } if job == id) {
                    episode.state = EpisodeState::Waiting;
                }
            }
        }
        count
    }
}

impl Evaluation {
    fn episode(&self, seed: u64) -> Option<&Episode> {
        self.episodes.iter().find(|episode| episode.seed == seed)
    }

    /// The scores, if all are there.
    fn scores(&self) -> Option<Vec<EpisodeScore>> {
        let score = |episode: &Episode| match episode.state {
            EpisodeState::Scored(score) => Some(score),
            _ => None,
        };
        self.episodes.iter().map(score).collect()
    }
}

fn require(holds: bool, refusal: Refusal) -> Result<(), Refusal> {
    if holds { Ok(()) } else { Err(refusal) }
}
