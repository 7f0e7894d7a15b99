//! The state machine.

use std::collections::{BTreeMap, BTreeSet};
use std::mem;
use std::sync::Arc;
use std::time::Instant;

use quad_protocol::{Hash, Job, JobReply, JobRequest, Name, Progress, ScoreReport};
use quad_run::counted;
use quad_run::folder::SavedScores;

use super::evaluators::Evaluators;
use super::message::{Answer, Count, End, Input, Order};
use super::outcomes::{Claim, Claimed, Lost};
use super::patience::{Patience, Verdict};
use super::queue::Deliveries;
use super::scoreboard::{Rules, Scoreboard};

/// Number of evaluations without scores from which on the evaluators are called slow.
const BEHIND: usize = 3;
/// Most characters of an evaluator's error message that the learner logs.
const LONGEST_REASON: usize = 300;
/// Most evaluator names for which the learner reports that two evaluators use them.
const MOST_SHARED_NAMES: usize = 100;

/// A run's evaluations and online episodes, from their opening to the acknowledgment of their
/// results.
#[derive(Debug)]
pub struct Service<Q> {
    pub(super) rules: Arc<Rules>,
    pub(super) board: Scoreboard,
    evaluators: Evaluators,
    pub(super) deliveries: Deliveries<Q>,
    patience: Patience,
    told: Told,
    pub(super) orders: Vec<Order<Q>>,
    begin: Instant,
}

/// Lines that are told once.
#[derive(Debug, Default)]
struct Told {
    /// Steps for which a failed job was told; online also the minute.
    failed_steps: BTreeSet<(u64, Option<u64>)>,
    shared_names: BTreeSet<Name>,
    version: bool,
    behind: bool,
}

/// Numbers for gauges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gauges {
    pub evaluators: usize,
    /// Episodes of evaluations that have no score, but may still get one.
    pub pending: usize,
    /// Episodes that are given up.
    pub missing: usize,
}

/// A connected evaluator and its job.
#[derive(Debug)]
pub struct Connected<'a> {
    pub name: &'a Name,
    /// True if it has the run's environment.
    pub fits: bool,
    pub last_seen: Option<Instant>,
    /// Its job, and the number of episodes that have ended.
    pub job: Option<(&'a Job, u32)>,
}

impl<Q> Service<Q> {
    /// A service without evaluations. `earlier` has the scores of earlier incarnations, `episodes`
    /// the seeds of online episodes that they may have opened, with the frame's hash of those on the
    /// disk.
    pub fn new(
        rules: Rules,
        earlier: BTreeMap<u64, SavedScores>,
        episodes: &[(u64, Option<Hash>)],
        now: Instant,
    ) -> Self {
        let rules = Arc::new(rules);
        let mut board = Scoreboard::new(rules.clone(), earlier);
        for &(seed, frame) in episodes {
            match frame {
                Some(hash) => drop(board.record_experience(seed, hash)),
                None => board.expect_online(seed),
            }
        }
        Self {
            rules,
            board,
            evaluators: Evaluators::new(now),
            deliveries: Deliveries::default(),
            patience: Patience::default(),
            told: Told::default(),
            orders: Vec::new(),
            begin: now,
        }
    }

    /// Takes a message or an event at this time.
    pub fn handle(&mut self, input: Input<Q>, now: Instant) -> Vec<Order<Q>> {
        match input {
            Input::Job(query, request) => {
                let reply = self.job(&request, now);
                self.orders.push(Order::Reply(query, Answer::Job(reply)));
            }
            Input::Scores(query, report) => {
                let ScoreReport { evaluator, incarnation, job, .. } = &report;
                self.board.extend_lease(evaluator, *incarnation, *job, now);
                self.scores(query, report);
            }
            Input::Piece(query, piece) => {
                self.board.extend_lease(&piece.evaluator, piece.incarnation, piece.job, now);
                self.piece(query, piece);
            }
            Input::Progress(progress) => self.progress(progress, now),
            Input::Joined(evaluator) => match self.evaluators.joined(&evaluator) {
                Ok(line) => self.orders.extend(line.map(Order::Tell)),
                Err(refusal) => self.orders.push(Order::rejected(refusal)),
            },
            Input::Left(evaluator) => self.left(evaluator, now),
            Input::OtherVersion(error) => {
                if !mem::replace(&mut self.told.version, true) {
                    self.tell(format!("an evaluator gets no job: {error}"));
                }
            }
            Input::Snapshot { step, weights } => {
                self.snapshot(step, weights);
                self.tell_if_behind();
            }
            Input::Opened(opening, weights) => {
                if opening.episode == 0 {
                    self.tell(format!("step {}: online learning begins", opening.step));
                }
                self.board.open_online(&opening, weights);
            }
            Input::Waits(episode) => self.board.wait_for_experience(episode, now),
            Input::Trained => self.trained(),
            Input::Flush => self.flush(),
            Input::Decoded(frame, episode) => self.decoded(frame, episode),
            Input::Appended(results) => self.appended(results),
            Input::Tick { training_waits } => self.tick(training_waits, now),
        }
        mem::take(&mut self.orders)
    }

    fn tell(&mut self, line: String) {
        self.orders.push(Order::Tell(line));
    }

    fn count_jobs(&mut self, outcome: &'static str, count: usize) {
        if count > 0 {
            self.orders.push(Order::Count(Count::Jobs(outcome, count)));
        }
    }

    /// Answers a claim or a hand-back.
    fn job(&mut self, request: &JobRequest, now: Instant) -> JobReply {
        let incarnation = self.rules.incarnation;
        match request {
            JobRequest::Claim { evaluator, attempt, environments } => {
                let fits = environments.contains(&self.rules.task.environment);
                self.evaluators.asked(evaluator, fits);
                let present = self.evaluators.count();
                let claim = Claim { evaluator, attempt: *attempt, fits, present };
                match self.board.claim(claim, now) {
                    Claimed::Job { job, again } => {
                        self.count_jobs("handed_out", usize::from(!again));
                        JobReply::Job(job)
                    }
                    Claimed::Wait(time) => {
                        JobReply::Wait { incarnation, milliseconds: time.as_millis() as u64 }
                    }
                }
            }
            JobRequest::HandBack { evaluator, job, failed } => {
                let lost = failed.is_some().then_some(now);
                let handed_back = self.board.hand_back(evaluator, *job, lost);
                let accepted = handed_back.is_some();
                if let Some((job, given_up)) = handed_back {
                    match failed {
                        Some(reason) => self.failed(&job, evaluator, reason, now),
                        None => self.count_jobs("handed_back", 1),
                    }
                    self.given_up(given_up.len());
                }
                JobReply::HandedBack { incarnation, accepted }
            }
        }
    }

    /// Tells of a job that an evaluator could not run, once for each step, and online, since
    /// training waits, each minute.
    fn failed(&mut self, job: &Job, evaluator: &Name, reason: &str, now: Instant) {
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

    fn given_up(&mut self, episodes: usize) {
        if episodes > 0 {
            let episodes = counted(episodes, "episode");
            self.tell(format!("{episodes} given up: too many evaluators were lost or failed"));
        }
    }

    fn progress(&mut self, progress: Progress, now: Instant) {
        let shares_name = match self.board.progress(&progress, now) {
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

    /// Frees the job of an evaluator that has left.
    fn left(&mut self, evaluator: Name, now: Instant) {
        let lost = self.board.release(&evaluator, Some(now));
        let (was_here, line) = self.evaluators.left(&evaluator, lost.jobs > 0);
        self.orders.extend(line.map(Order::Tell));
        self.lost(&lost);
        if was_here {
            self.orders.push(Order::Forget(evaluator));
        }
    }

    fn lost(&mut self, lost: &Lost) {
        self.count_jobs("expired", lost.jobs);
        self.given_up(lost.given_up.len());
    }

    /// Tells once that the evaluators are slower than training.
    fn tell_if_behind(&mut self) {
        let waiting = self.board.evaluations_pending();
        if waiting >= BEHIND && self.evaluators.count() > 0 && !self.told.behind {
            self.told.behind = true;
            self.tell(format!(
                "the evaluators are slower than the training, which does not wait for them: {waiting} evaluations have no \
                 score yet; more evaluators or a longer --eval-interval end the run sooner"
            ));
        }
    }

    fn trained(&mut self) {
        self.board.end_online();
        self.patience = Patience::after_training();
        let present = match self.evaluators.count() {
            0 => "no evaluator".to_owned(),
            count => counted(count, "evaluator"),
        };
        self.tell(match self.board.pending() {
            0 => "training is done".to_owned(),
            pending => {
                let episodes = counted(pending, "episode");
                format!("training is done; waiting for the scores of {episodes} ({present} here)")
            }
        });
    }

    fn tick(&mut self, training_waits: bool, now: Instant) {
        let line = self.evaluators.tick(now);
        self.orders.extend(line.map(Order::Tell));
        let expired = self.board.expire(now);
        if expired.jobs > 0 {
            let jobs = counted(expired.jobs, "job");
            self.tell(format!("{jobs} made no progress; other evaluators get the episodes"));
        }
        self.lost(&expired);
        if self.patience.trained && self.board.pending() == 0 {
            return self.orders.push(Order::End(End::Complete));
        }
        let waits = self.patience.trained || training_waits;
        match self.patience.check(self.evaluators.any_may_fit() || !waits, now) {
            Verdict::Wait => {}
            Verdict::Advise => self.orders.push(Order::Advise),
            Verdict::GiveUp => self.orders.push(Order::End(End::Unscored)),
        }
    }

    /// Hash of the snapshot of a step whose episodes are run.
    pub fn weights(&self, step: u64) -> Option<Hash> {
        self.board.weights(step)
    }

    pub fn gauges(&self) -> Gauges {
        let (pending, missing) = (self.board.pending(), self.board.missing().len());
        Gauges { evaluators: self.evaluators.count(), pending, missing }
    }

    pub fn connected(&self) -> impl Iterator<Item = Connected<'_>> {
        self.evaluators.iter().map(|(name, fits, last_seen)| {
            let job = self.board.job_of(name);
            Connected { name, fits, last_seen, job }
        })
    }
}
