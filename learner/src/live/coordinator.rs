//! The state that threads share: the scoreboard and the connected evaluators, behind one lock.
//!
//! Every thread may call it. It holds the lock for microseconds, never during input or output: the
//! caller does slow work, like writing scores, between two calls.

use std::collections::{BTreeMap, BTreeSet};
use std::mem;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use quad_protocol::{
    CodecError, Episode, EpisodeScore, Hash, Job, JobReply, JobRequest, Name, Piece, PieceReply,
    Progress, ScoreReply, ScoreReport, episode_seeds,
};
use quad_run::counted;
use quad_run::folder::SavedScores;
use serde_json::{Value, json};
use tracing::{debug, warn};

use super::evaluators::Evaluators;
use super::events::{Event, Events};
use super::metrics::{Metrics, unix_time};
use super::requests::NotAccepted;
use crate::evaluation::{
    Claim, Claimed, Lost, Opening, OtherWeights, PracticeEpisode, Refusal, Rules, Scoreboard,
    Validated,
};

/// Most characters of an evaluator's error message that the learner logs.
const LONGEST_REASON: usize = 300;
/// Most evaluator names for which the learner reports that two evaluators use them.
const MOST_SHARED_NAMES: usize = 100;

/// A handle to the shared state. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct Coordinator {
    state: Arc<Mutex<State>>,
    rules: Arc<Rules>,
    pub(super) metrics: Metrics,
    pub(super) events: Events,
}

#[derive(Debug)]
struct State {
    scoreboard: Scoreboard,
    evaluators: Evaluators,
    /// Steps for which a failed job was reported; of practice also the minutes, since 1970.
    failed_steps: BTreeSet<(u64, Option<u64>)>,
    /// Names for which it was reported that two evaluators use them.
    shared_names: BTreeSet<Name>,
    /// True once it was reported that an evaluator has another version.
    told_version: bool,
}

impl Coordinator {
    /// A coordinator without evaluations; see [`Scoreboard::new`].
    pub fn new(
        rules: Rules,
        earlier: BTreeMap<u64, SavedScores>,
        metrics: Metrics,
        events: Events,
    ) -> Self {
        let rules = Arc::new(rules);
        let state = State {
            scoreboard: Scoreboard::new(rules.clone(), earlier),
            evaluators: Evaluators::new(metrics.clone(), events.clone(), Instant::now()),
            failed_steps: BTreeSet::new(),
            shared_names: BTreeSet::new(),
            told_version: false,
        };
        Self { state: Arc::new(Mutex::new(state)), rules, metrics, events }
    }

    /// The environment in which evaluators run the policies.
    pub fn environment(&self) -> &str {
        &self.rules.task.environment
    }

    /// True if an evaluator is connected that may have this environment.
    pub fn any_may_fit(&self) -> bool {
        self.lock().evaluators.any_may_fit()
    }

    /// Each connected evaluator and its job, for the page.
    pub fn evaluators(&self) -> Vec<Value> {
        let state = self.lock();
        state.evaluators.to_json(|evaluator| {
            let (job, done) = state.scoreboard.job_of(evaluator)?;
            Some(json!({
                "step": job.step,
                "practice": job.practice.is_some(),
                "done": done,
                "episodes": job.seeds.len(),
            }))
        })
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
        let seeds = episode_seeds(self.rules.seed, step, self.rules.episodes);
        let mut state = self.lock();
        if let Some(scores) = state.scoreboard.add_evaluation(step, weights, &seeds)? {
            self.show(step, &scores);
        }
        self.count(&state);
        Ok(())
    }

    /// Opens an episode of practice.
    pub fn open_practice(&self, opening: &Opening, weights: Hash) {
        if opening.episode == 0 {
            self.events.line(format!("step {}: practice begins", opening.step));
        }
        self.lock().scoreboard.open_practice(opening, weights);
    }

    /// Expects an episode of practice that an earlier incarnation may have opened.
    pub fn expect_practice(&self, seed: u64) {
        self.lock().scoreboard.expect_practice(seed);
    }

    /// Records that training waits for this practice episode from now on.
    pub fn wait_for_practice(&self, episode: u64) {
        self.lock().scoreboard.wait_for_practice(episode, Instant::now());
    }

    /// Ends practice: evaluators get no more of its episodes.
    pub fn end_practice(&self) {
        self.lock().scoreboard.end_practice();
    }

    /// Number of this start of the learner.
    pub fn incarnation(&self) -> u64 {
        self.rules.incarnation
    }

    /// The practice episode of a piece, if the run has it and it is not too long.
    pub(super) fn practice(&self, piece: &Piece) -> Result<PracticeEpisode, Refusal> {
        self.lock().scoreboard.practice(piece)
    }

    /// Checks the episode of practice with this number. Changes nothing.
    pub(super) fn validate_practice(&self, number: u64, episode: &Episode) -> Result<(), Refusal> {
        self.lock().scoreboard.validate_practice(number, episode)
    }

    /// Counts an episode of practice that is on the disk. Returns its acknowledgment.
    pub(super) fn record_practice(&self, seed: u64, frame: Hash) -> PieceReply {
        let jobs = self.lock().scoreboard.record_practice(seed, frame);
        self.metrics.jobs("completed", jobs);
        PieceReply::Recorded { incarnation: self.rules.incarnation, duplicate: false }
    }

    /// Hash of the snapshot that is evaluated for a step.
    pub fn weights(&self, step: u64) -> Option<Hash> {
        self.lock().scoreboard.weights(step)
    }

    /// Number of episodes that have no score, but may still get one.
    pub fn pending(&self) -> usize {
        self.lock().scoreboard.pending()
    }

    /// Number of evaluations with such episodes.
    pub fn evaluations_pending(&self) -> usize {
        self.lock().scoreboard.evaluations_pending()
    }

    /// Answers a claim or a hand-back.
    pub fn job(&self, request: &JobRequest) -> JobReply {
        let (mut state, now) = (self.lock(), Instant::now());
        let incarnation = self.rules.incarnation;
        match request {
            JobRequest::Claim { evaluator, attempt, environments } => {
                let fits = environments.iter().any(|name| name == self.environment());
                state.evaluators.asked(evaluator, fits);
                let present = state.evaluators.count();
                let claim = Claim { evaluator, attempt: *attempt, fits, present };
                match state.scoreboard.claim(claim, now) {
                    Claimed::Job { job, again } => {
                        if !again {
                            debug!(job = job.id, step = job.step, %evaluator, "handed out");
                            self.metrics.jobs("handed_out", 1);
                        }
                        JobReply::Job(job)
                    }
                    Claimed::Wait(time) => {
                        JobReply::Wait { incarnation, milliseconds: time.as_millis() as u64 }
                    }
                }
            }
            JobRequest::HandBack { evaluator, job, failed } => {
                let when = failed.is_some().then_some(now);
                let handed_back = state.scoreboard.hand_back(evaluator, *job, when);
                let accepted = handed_back.is_some();
                if let Some((job, given_up)) = handed_back {
                    match failed {
                        Some(reason) => self.failed(&mut state, &job, evaluator, reason),
                        None => self.metrics.jobs("handed_back", 1),
                    }
                    self.given_up(&state, &given_up);
                }
                JobReply::HandedBack { incarnation, accepted }
            }
        }
    }

    /// Reports once that a claim is of another version: its evaluator is here and gets no job.
    pub(super) fn unread_claim(&self, why: &NotAccepted) {
        if let NotAccepted::Codec(error @ CodecError::Version { .. }) = why
            && !mem::replace(&mut self.lock().told_version, true)
        {
            self.events.line(format!("an evaluator gets no job: {error}"));
        }
    }

    pub(super) fn progress(&self, progress: &Progress) -> Result<(), Refusal> {
        let (mut state, now) = (self.lock(), Instant::now());
        let shares_name = state.scoreboard.progress(progress, now)?;
        let (names, name) = (&mut state.shared_names, &progress.evaluator);
        if shares_name && names.len() < MOST_SHARED_NAMES && names.insert(name.clone()) {
            self.events.line(format!(
                "two evaluators were started with --name {name}, and one of them gets no work; give each its own name"
            ));
        }
        state.evaluators.progress(progress, now);
        Ok(())
    }

    pub(super) fn joined(&self, evaluator: Name) -> Result<(), NotAccepted> {
        self.lock().evaluators.joined(evaluator)
    }

    /// Records that an evaluator has left; its job becomes free for others.
    pub fn left(&self, evaluator: &Name) {
        let mut state = self.lock();
        let lost = state.scoreboard.release(evaluator, Some(Instant::now()));
        state.evaluators.left(evaluator, lost.jobs > 0);
        self.lost(&state, &lost);
    }

    /// Checks a report and finds its new scores. Changes nothing.
    pub fn validate(&self, report: &ScoreReport) -> Result<Validated, Refusal> {
        self.lock().scoreboard.validate(report)
    }

    /// Extends the lease of a job whose scores have arrived but are not on the disk yet.
    pub fn extend_lease(&self, evaluator: &Name, incarnation: u64, job: u64) {
        self.lock().scoreboard.extend_lease(evaluator, incarnation, job, Instant::now());
    }

    /// Counts scores of a report that are on the disk. Returns its acknowledgment.
    pub fn record(&self, report: &ScoreReport, validated: &Validated) -> ScoreReply {
        let mut state = self.lock();
        let Validated { new, duplicates } = validated;
        let recorded = state.scoreboard.record(report, new);
        let evaluation = &self.metrics.evaluation;
        evaluation.scores_recorded.inc_by(new.len() as u64);
        evaluation.scores_duplicate.inc_by((*duplicates).into());
        self.metrics.jobs("completed", recorded.jobs_completed);
        if let Some(scores) = recorded.evaluation_completed {
            self.show(report.step, &scores);
            self.events.send(Event::Evaluated { step: report.step, scores });
        }
        self.count(&state);
        let (incarnation, new) = (self.rules.incarnation, new.len() as u32);
        ScoreReply::Recorded { incarnation, new, duplicates: *duplicates }
    }

    /// Takes back jobs whose lease has expired. Call it several times a second.
    pub fn tick(&self) {
        let (mut state, now) = (self.lock(), Instant::now());
        state.evaluators.tick(now);
        let expired = state.scoreboard.expire(now);
        if expired.jobs > 0 {
            let jobs = counted(expired.jobs, "job");
            self.events.line(format!("{jobs} made no progress; other evaluators get the episodes"));
        }
        self.lost(&state, &expired);
        self.metrics.evaluation.episodes_missing.set(state.scoreboard.missing().len() as i64);
    }

    /// Reports a job that an evaluator could not run, once for each step and, of practice, each
    /// minute.
    fn failed(&self, state: &mut State, job: &Job, evaluator: &Name, reason: &str) {
        let (step, practice) = (job.step, job.practice.is_some());
        self.metrics.jobs("failed", 1);
        let printable = reason.chars().filter(|c| !c.is_control());
        let reason = String::from_iter(printable.take(LONGEST_REASON));
        debug!(step, %evaluator, reason, "a job failed");
        // Training waits for practice, so its failures are told again.
        let minute = practice.then(|| unix_time() as u64 / 60);
        if state.failed_steps.insert((step, minute)) {
            let what = if practice { "play practice" } else { "do a job" };
            self.events.line(format!(
                "evaluator {evaluator} could not {what} of step {step}, which goes to others: {reason}"
            ));
        }
    }

    fn lost(&self, state: &State, lost: &Lost) {
        self.metrics.jobs("expired", lost.jobs);
        self.given_up(state, &lost.given_up);
    }

    fn given_up(&self, state: &State, episodes: &[(u64, u64)]) {
        const REASON: &str = "too many evaluators were lost or failed";
        for (step, seed) in episodes {
            warn!(step, seed, "an episode is given up");
        }
        if !episodes.is_empty() {
            let episodes = counted(episodes.len(), "episode");
            self.events.line(format!("{episodes} given up: {REASON}"));
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
            let sum: f64 = scores.iter().map(|score| score.score).sum();
            evaluation.score.set(sum / scores.len() as f64);
            evaluation.step.set(step);
        }
    }
}
