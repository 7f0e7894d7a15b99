//! Which evaluator has which job, and which episodes are scored: the scoreboard and the evaluators
//! behind one lock.
//!
//! Every thread may call it. It holds the lock for microseconds, never during input or output: the
//! caller does slow work, like writing scores, between two calls.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use quad_protocol::{
    EpisodeScore, Hash, JobReply, JobRequest, Name, Progress, ScoreReply, ScoreReport,
    episode_seeds,
};
use quad_run::folder::SavedScores;
use tracing::{debug, warn};

use super::evaluators::{EvaluatorAtWork, Evaluators, JobAtWork};
use super::events::{Event, Events};
use super::metrics::Metrics;
use super::requests::NotAccepted;
use crate::evaluation::{
    Claim, Claimed, HandedBack, Lost, OtherWeights, Refusal, Rules, Scoreboard, Validated,
};

/// Most characters of an evaluator's error message that the learner logs.
const LONGEST_REASON: usize = 300;
/// Most evaluator names for which the learner reports that two evaluators use them.
const MOST_NAMES_TOLD: usize = 100;

/// The episodes of each evaluation of a run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct EvaluationPlan {
    /// Seed of the run.
    pub seed: u64,
    /// Episodes per evaluation.
    pub episodes: u32,
}

/// A handle to the shared state. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct Coordinator {
    state: Arc<Mutex<State>>,
    plan: EvaluationPlan,
    incarnation: u64,
    environment: String,
    metrics: Metrics,
    events: Events,
}

#[derive(Debug)]
struct State {
    scoreboard: Scoreboard,
    evaluators: Evaluators,
    /// Steps for which a failed job was reported.
    failures_told: BTreeSet<u64>,
    /// Names for which it was reported that two evaluators use them.
    names_told: BTreeSet<Name>,
}

impl Coordinator {
    /// A coordinator without evaluations; see [`Scoreboard::new`].
    pub fn new(
        rules: Rules,
        plan: EvaluationPlan,
        earlier: BTreeMap<u64, SavedScores>,
        metrics: Metrics,
        events: Events,
    ) -> Self {
        let (incarnation, environment) = (rules.incarnation, rules.task.environment.clone());
        let state = State {
            scoreboard: Scoreboard::new(rules, earlier),
            evaluators: Evaluators::new(metrics.evaluators.clone(), Instant::now()),
            failures_told: BTreeSet::new(),
            names_told: BTreeSet::new(),
        };
        Self { state: Arc::new(Mutex::new(state)), plan, incarnation, environment, metrics, events }
    }

    /// The environment in which evaluators run the policies.
    pub fn environment(&self) -> &str {
        &self.environment
    }

    /// Whether an evaluator is connected that may have this environment.
    pub fn any_may_fit(&self) -> bool {
        self.lock().evaluators.any_may_fit()
    }

    /// Each connected evaluator and its job, for the page.
    pub fn evaluators(&self) -> Vec<EvaluatorAtWork> {
        let state = self.lock();
        let present = state.evaluators.present();
        let at_work = present.map(|(evaluator, fits, seen)| EvaluatorAtWork {
            name: evaluator.to_string(),
            fits,
            seconds_ago: seen.map(|seen| seen.elapsed().as_secs_f64()),
            job: state.scoreboard.job_of(evaluator).map(|(step, done, episodes)| JobAtWork {
                step,
                done,
                episodes,
            }),
        });
        at_work.collect()
    }

    // A panic with the lock held ends the run.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Opens the evaluation of a snapshot.
    ///
    /// # Errors
    /// The step is known with other weights.
    pub fn open(&self, step: u64, weights: Hash) -> Result<(), OtherWeights> {
        let seeds = episode_seeds(self.plan.seed, step, self.plan.episodes);
        let mut state = self.lock();
        if let Some(scores) = state.scoreboard.add_evaluation(step, weights, &seeds)? {
            self.show(step, &scores);
        }
        self.count(&state);
        Ok(())
    }

    /// Hash of the snapshot that is evaluated for a step.
    pub fn weights(&self, step: u64) -> Option<Hash> {
        self.lock().scoreboard.weights(step)
    }

    /// Episodes that have no score, but may still get one.
    pub fn pending(&self) -> usize {
        self.lock().scoreboard.pending()
    }

    /// Evaluations with such episodes.
    pub fn evaluations_pending(&self) -> usize {
        self.lock().scoreboard.evaluations_pending()
    }

    /// Answers a claim or a hand-back.
    pub fn job(&self, request: &JobRequest) -> JobReply {
        let mut state = self.lock();
        match request {
            JobRequest::Claim { evaluator, attempt, environments } => {
                let present = state.evaluators.count();
                state.evaluators.asks(evaluator, environments.contains(&self.environment));
                let claim = Claim { evaluator, attempt: *attempt, environments, present };
                let claimed = state.scoreboard.claim(claim, Instant::now());
                self.claimed(evaluator, claimed)
            }
            JobRequest::HandBack { evaluator, job, failed } => {
                let when = failed.is_some().then(Instant::now);
                let handed_back = state.scoreboard.hand_back(evaluator, *job, when);
                let accepted = handed_back.is_some();
                if let Some(HandedBack { step, given_up }) = handed_back {
                    match failed {
                        Some(reason) => self.failed(&mut state, step, evaluator, reason),
                        None => self.metrics.evaluation.jobs_handed_back.inc(),
                    }
                    self.given_up(&state, given_up);
                }
                JobReply::HandedBack { incarnation: self.incarnation, accepted }
            }
        }
    }

    fn claimed(&self, evaluator: &Name, claimed: Claimed) -> JobReply {
        match claimed {
            Claimed::Job { job, again } => {
                if !again {
                    debug!(job = job.id, step = job.step, %evaluator, "handed out");
                    self.metrics.evaluation.jobs_handed_out.inc();
                }
                JobReply::Job(job)
            }
            Claimed::Wait(time) => JobReply::Wait {
                incarnation: self.incarnation,
                milliseconds: time.as_millis() as u64,
            },
        }
    }

    /// Records an evaluator's progress.
    pub fn progress(&self, progress: Progress) -> Result<(), NotAccepted> {
        let (mut state, now) = (self.lock(), Instant::now());
        let shares_name = state.scoreboard.progress(&progress, now)?;
        let (names, name) = (&mut state.names_told, &progress.evaluator);
        if shares_name && names.len() < MOST_NAMES_TOLD && names.insert(name.clone()) {
            self.events.send(Event::SameName(name.clone())).ok();
        }
        state.evaluators.heard(progress, now)
    }

    /// Records that an evaluator has connected.
    pub fn joined(&self, evaluator: Name) -> Result<(), NotAccepted> {
        self.lock().evaluators.joined(evaluator)
    }

    /// Records that an evaluator has left; its job becomes free for others.
    pub fn left(&self, evaluator: &Name) {
        let mut state = self.lock();
        let lost = state.scoreboard.evaluator_gone(evaluator, Instant::now());
        state.evaluators.left(evaluator, lost.jobs);
        self.lost(&state, lost);
    }

    /// Checks reports and finds the new scores in each. Changes nothing.
    pub fn validate<'a>(
        &self,
        reports: impl Iterator<Item = &'a ScoreReport>,
    ) -> Vec<Result<Validated, Refusal>> {
        let state = self.lock();
        reports.map(|report| state.scoreboard.validate(report)).collect()
    }

    /// Extends the lease of a job whose scores have arrived but are not on the disk yet.
    pub fn keep(&self, report: &ScoreReport) {
        self.lock().scoreboard.keep(report, Instant::now());
    }

    /// Counts scores that are on the disk. Returns the acknowledgment of each report.
    pub fn record<'a>(
        &self,
        reports: impl Iterator<Item = (&'a ScoreReport, &'a Validated)>,
    ) -> Vec<ScoreReply> {
        let mut state = self.lock();
        let replies = reports
            .map(|(report, validated)| self.record_one(&mut state, report, validated))
            .collect();
        self.count(&state);
        replies
    }

    fn record_one(
        &self,
        state: &mut State,
        report: &ScoreReport,
        validated: &Validated,
    ) -> ScoreReply {
        let Validated { new, duplicates } = validated;
        let recorded = state.scoreboard.record(report, new);
        let evaluation = &self.metrics.evaluation;
        evaluation.scores_recorded.inc_by(new.len() as u64);
        evaluation.scores_duplicate.inc_by((*duplicates).into());
        evaluation.jobs_completed.inc_by(recorded.jobs_completed as u64);
        if let Some(scores) = recorded.evaluation_completed {
            self.show(report.step, &scores);
            self.events.send(Event::Evaluated { step: report.step, scores }).ok();
        }
        ScoreReply::Recorded {
            incarnation: self.incarnation,
            new: new.len() as u32,
            duplicates: *duplicates,
        }
    }

    /// The answer to a report that the learner will never accept.
    pub fn refused(&self, refusal: Refusal) -> ScoreReply {
        ScoreReply::Refused { incarnation: self.incarnation, reason: refusal.to_string() }
    }

    /// Takes back jobs whose lease has expired, and forgets evaluators that left long ago. Returns
    /// lines for the log. Call it several times a second.
    pub fn tick(&self) -> Vec<String> {
        let (mut state, now) = (self.lock(), Instant::now());
        let mut lines = state.evaluators.tick(now);
        let expired = state.scoreboard.expire(now);
        if expired.jobs > 0 {
            lines.push(format!("{} jobs made no progress; they go to others", expired.jobs));
        }
        self.lost(&state, expired);
        self.metrics.evaluation.episodes_missing.set(state.scoreboard.missing().len() as i64);
        lines
    }

    /// Reports a job that an evaluator could not run, once for each step.
    fn failed(&self, state: &mut State, step: u64, evaluator: &Name, reason: &str) {
        self.metrics.evaluation.jobs_failed.inc();
        let reason: String =
            reason.chars().filter(|c| !c.is_control()).take(LONGEST_REASON).collect();
        debug!(step, %evaluator, reason, "a job failed");
        if state.failures_told.insert(step) {
            self.events.send(Event::JobFailed { step, evaluator: evaluator.clone(), reason }).ok();
        }
    }

    fn lost(&self, state: &State, lost: Lost) {
        self.metrics.evaluation.jobs_expired.inc_by(lost.jobs as u64);
        self.given_up(state, lost.given_up);
    }

    fn given_up(&self, state: &State, episodes: Vec<(u64, u64)>) {
        for (step, seed) in &episodes {
            warn!(
                step,
                seed,
                "an episode is given up: too many evaluators were lost with it or could not do it"
            );
        }
        if !episodes.is_empty() {
            self.events.send(Event::GivenUp(episodes)).ok();
        }
        self.count(state);
    }

    fn count(&self, state: &State) {
        self.metrics.evaluation.episodes_pending.set(state.scoreboard.pending() as i64);
    }

    /// Sets the metrics to a complete evaluation, if it is the newest.
    fn show(&self, step: u64, scores: &[EpisodeScore]) {
        let evaluation = &self.metrics.evaluation;
        if let Ok(step) = i64::try_from(step)
            && step >= evaluation.step.get()
        {
            evaluation
                .score
                .set(scores.iter().map(|score| score.score).sum::<f64>() / scores.len() as f64);
            evaluation.step.set(step);
        }
    }
}
