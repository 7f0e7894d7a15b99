//! The state machine of a run: which episodes there are, who plays them, what has come, what is on
//! the disk, and what is acknowledged. It does no input or output, has no thread and no lock, and
//! asks no clock: [`Service::handle`] takes a message or an event with its time, and returns
//! [`Order`]s. The module `live` brings the ones and does the others.
//!
//! An evaluation is a snapshot (step and hash) with a list of episode seeds. A job gives some of
//! its episodes to one evaluator under a lease, which progress extends. When the lease ends, or the
//! evaluator leaves, the learner gives these episodes to another evaluator, unless that has
//! happened too often. For each (step, seed) only the first delivered score counts, whichever
//! evaluator delivers it.
//!
//! An online episode is handed out like an evaluation's, but alone, before all others, and as often
//! as it takes. Its rows arrive in pieces.
//!
//! In reading order: `message` (what it takes and orders); its state: `evaluation` (episodes of one
//! snapshot), `open_job`, `online_episode` and `queue`; `claims` (jobs for evaluators) and `leases` (their end); `deliveries` (from their arrival to
//! their acknowledgment), which are `scores` or `online` episodes; `evaluators` and `patience`
//! (who is there); `online_schedule` is training's, of online episodes and gradient steps.

mod claims;
mod deliveries;
mod evaluation;
mod evaluators;
mod leases;
mod message;
mod online;
mod online_episode;
mod online_schedule;
mod open_job;
mod patience;
mod queue;
mod scores;
#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::mem;
use std::time::{Duration, Instant};

use quad_dataset::Task;
use quad_protocol::{Episode, Hash, Job, Message, Name};
use quad_run::config::Schedule;
use quad_run::counted;
use quad_run::folder::SavedScores;

use self::evaluation::{Evaluation, Key};
use self::evaluators::Evaluators;
pub use self::message::{Answer, Count, End, Frame, Input, Order, OtherWeights};
use self::online_episode::OnlineEpisode;
pub use self::online_schedule::{OnlineSchedule, Opening};
use self::open_job::OpenJob;
use self::patience::{Patience, Verdict};
use self::queue::Deliveries;

/// Number of evaluations without scores from which on the evaluators are called slow.
const BEHIND: usize = 3;

/// Constants of all evaluations of a run.
#[derive(Clone, Debug)]
pub struct Rules {
    pub run: Name,
    /// Number of this start of the learner.
    pub incarnation: u64,
    pub task: Task,
    /// Seed of the run: of its episodes, and of what the environment draws once for the whole run.
    pub seed: u64,
    /// Sizes of an observation and of an action.
    pub dims: (usize, usize),
    /// Episodes per evaluation.
    pub episodes: u32,
    pub schedule: Schedule,
    /// Most episodes in one job: while as many evaluators as there are could share them, and if
    /// many more wait.
    pub job_episodes: [usize; 2],
    /// Longest time of a job without progress. It is longer if there are so many evaluators that
    /// they report progress rarely.
    pub lease: Duration,
}

impl Rules {
    /// Most bytes of an online episode's frame.
    fn longest_frame(&self) -> usize {
        let steps = self.task.max_episode_steps().unwrap_or(Episode::LONGEST).min(Episode::LONGEST);
        let numbers = self.dims.0 + self.dims.1 + 2;
        ((steps + 1) * numbers * size_of::<f32>() + (1 << 10)).min(Episode::LIMIT)
    }
}

/// A run's evaluations and online episodes, from their opening to the acknowledgment of their
/// results. `Q` is a query, by which its answer finds the way back.
#[derive(Debug)]
pub struct Service<Q> {
    rules: Rules,
    begin: Instant,
    evaluators: Evaluators,
    /// Evaluations, and the online episodes that are not on the disk.
    evaluations: BTreeMap<Key, Evaluation>,
    /// Scores of an earlier incarnation, by step, whose evaluation is not open yet.
    earlier: BTreeMap<u64, SavedScores>,
    /// Online episodes by seed.
    online: HashMap<u64, OnlineEpisode>,
    /// Number of the online episode that training waits for, and since when.
    awaited: Option<(u64, Instant)>,
    /// True once training is complete.
    trained: bool,
    jobs: BTreeMap<Name, OpenJob>,
    next_job: u64,
    deliveries: Deliveries<Q>,
    patience: Patience,
    told: Told,
    orders: Vec<Order<Q>>,
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
        let online = episodes.iter().map(|&(seed, frame)| {
            (seed, frame.map_or(OnlineEpisode::Expected, OnlineEpisode::Recorded))
        });
        Self {
            rules,
            begin: now,
            evaluators: Evaluators::new(now),
            evaluations: BTreeMap::new(),
            earlier,
            online: online.collect(),
            awaited: None,
            trained: false,
            jobs: BTreeMap::new(),
            next_job: 1,
            deliveries: Deliveries::new(),
            patience: Patience::default(),
            told: Told::default(),
            orders: Vec::new(),
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
                self.extend_lease(&report.evaluator, report.incarnation, report.job, now);
                self.report_arrived(query, report);
            }
            Input::Piece(query, piece) => {
                self.extend_lease(&piece.evaluator, piece.incarnation, piece.job, now);
                self.piece_arrived(query, piece);
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
                self.open_evaluation(step, weights);
                self.tell_if_behind();
            }
            Input::Opened(opening, weights) => {
                if opening.episode == 0 {
                    self.tell(format!("step {}: online learning begins", opening.step));
                }
                self.open_online(&opening, weights);
            }
            Input::Waits(episode) => self.awaited = Some((episode, now)),
            Input::Trained => self.training_ended(),
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

    /// Tells once that the evaluators are slower than training.
    fn tell_if_behind(&mut self) {
        let evaluations = self.evaluations.range(Key::FIRST_EVALUATION..);
        let waiting = evaluations.filter(|(_, evaluation)| evaluation.pending() > 0).count();
        if waiting >= BEHIND && self.evaluators.count() > 0 && !self.told.behind {
            self.told.behind = true;
            self.tell(format!(
                "the evaluators are slower than the training, which does not wait for them: {waiting} evaluations have no \
                 score yet; more evaluators or a longer --eval-interval end the run sooner"
            ));
        }
    }

    /// Evaluators get no more online episodes. Those that are open are still accepted; those that
    /// were expected are refused, since training has come to all that it needs.
    fn training_ended(&mut self) {
        self.trained = true;
        self.online.retain(|_, episode| !matches!(episode, OnlineEpisode::Expected));
        self.patience = Patience::default();
        let Gauges { evaluators, pending, .. } = self.gauges();
        let present = match evaluators {
            0 => "no evaluator".to_owned(),
            count => counted(count, "evaluator"),
        };
        self.tell(match pending {
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
        self.expire(now);
        if self.trained && self.gauges().pending == 0 {
            return self.orders.push(Order::End(End::Complete));
        }
        let waits = self.trained || training_waits;
        match self.patience.check(self.evaluators.any_may_fit() || !waits, self.trained, now) {
            Verdict::Wait => {}
            Verdict::Advise => self.orders.push(Order::Advise),
            Verdict::GiveUp => self.orders.push(Order::End(End::Unscored)),
        }
    }

    /// Hash of the snapshot of a step whose episodes are run.
    pub fn weights(&self, step: u64) -> Option<Hash> {
        let mut evaluations = self.evaluations.values();
        evaluations.find(|evaluation| evaluation.step == step).map(|evaluation| evaluation.weights)
    }

    pub fn gauges(&self) -> Gauges {
        let mut gauges = Gauges { evaluators: self.evaluators.count(), pending: 0, missing: 0 };
        for (_, evaluation) in self.evaluations.range(Key::FIRST_EVALUATION..) {
            gauges.pending += evaluation.pending();
            gauges.missing += evaluation.missing();
        }
        gauges
    }

    pub fn connected(&self) -> impl Iterator<Item = Connected<'_>> {
        self.evaluators.iter().map(|(name, fits, last_seen)| {
            let job = self.jobs.get(name).map(OpenJob::progress);
            Connected { name, fits, last_seen, job }
        })
    }
}
