//! Virtual time, the network, and the order of all events. Every choice follows from one seed.

use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap};
use std::time::{Duration, Instant};

use quad_learner::service::{End, Input};
use quad_protocol::{
    Hash, JobReply, JobRequest, Name, Piece, PieceReply, Progress, ScoreReply, ScoreReport,
};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};

use crate::disk::Disk;
use crate::evaluator::EvaluatorProcess;
use crate::learner::LearnerProcess;
use crate::settings::Settings;
use crate::strangers;
use crate::training::Reference;

/// A run that has not ended by then never will.
const LONGEST: Duration = Duration::from_secs(24 * 3600);
const MOST_EVENTS: u64 = 2_000_000;

/// The sender of a query, to whom the answer goes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sender {
    pub evaluator: usize,
    pub epoch: u32,
    pub query: u64,
}

impl Sender {
    /// No evaluator waits for its answers.
    pub const STRANGER: Self = Self { evaluator: usize::MAX, epoch: 0, query: 0 };
}

#[derive(Clone, Debug)]
pub enum Query {
    Job(JobRequest),
    Scores(ScoreReport),
    Piece(Piece),
    Weights(u64),
}

#[derive(Clone, Debug)]
pub enum Reply {
    Job(JobReply),
    Scores(ScoreReply),
    Piece(PieceReply),
    Weights(u64, Hash),
    Error,
}

/// Names of evaluators are followed by the number of their start, learners' events by theirs.
#[derive(Clone, Debug)]
pub enum Event {
    Query(Sender, Query),
    Answer(Sender, Reply),
    Timeout(Sender),
    Progress(Progress),
    /// The learner sees whether an evaluator is there.
    Token(usize),
    /// An evaluator sees the learners that are there.
    Learners(usize, u32),
    Turn(usize, u32),
    Played(usize, u32),
    Train(u32),
    Written(u32),
    Appended(u32),
    Tick(u32),
    CrashLearner,
    StartLearner,
    CrashEvaluator(usize),
    StartEvaluator(usize),
    LeaveEvaluator(usize),
    Cut(usize),
    Heal(usize),
    DiskFails(bool),
    Stranger,
}

struct Scheduled {
    at: Duration,
    number: u64,
    event: Event,
}

impl PartialEq for Scheduled {
    fn eq(&self, other: &Self) -> bool {
        self.number == other.number
    }
}

impl Eq for Scheduled {}

impl PartialOrd for Scheduled {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Scheduled {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.at, self.number).cmp(&(other.at, other.number))
    }
}

pub struct World {
    pub rng: StdRng,
    pub settings: Settings,
    reference: Reference,
    start: Instant,
    pub now: Duration,
    queue: BinaryHeap<Reverse<Scheduled>>,
    number: u64,
    pub learner: LearnerProcess,
    pub evaluators: Vec<EvaluatorProcess>,
    pub disk: Disk,
    pub acknowledged_scores: BTreeSet<(u64, u64)>,
    pub acknowledged_episodes: BTreeSet<u64>,
    pub trained: bool,
    pub ended: Option<End>,
    pub trace: Option<Vec<String>>,
}

pub fn name(text: &str) -> Name {
    Name::new(text).expect("an allowed name")
}

impl World {
    /// The world of a seed; with a trace of all that happens, if asked.
    pub fn new(seed: u64, traced: bool) -> Self {
        let mut rng = StdRng::seed_from_u64(seed);
        let settings = Settings::draw(&mut rng);
        let mut world = Self {
            reference: Reference::new(&settings),
            rng,
            settings,
            start: Instant::now(),
            now: Duration::ZERO,
            queue: BinaryHeap::new(),
            number: 0,
            learner: LearnerProcess::default(),
            evaluators: Vec::new(),
            disk: Disk::default(),
            acknowledged_scores: BTreeSet::new(),
            acknowledged_episodes: BTreeSet::new(),
            trained: false,
            ended: None,
            trace: traced.then(Vec::new),
        };
        for number in 0..world.settings.evaluators {
            let evaluator = EvaluatorProcess::new(&mut world, number);
            world.evaluators.push(evaluator);
        }
        world
    }

    /// Runs to the end, and checks what has come out.
    pub fn run(&mut self) -> Result<(), String> {
        self.start_learner()?;
        self.schedule_faults();
        for events in 0.. {
            if let Some(end) = self.ended.take() {
                return self.check_end(end);
            }
            let Some(Reverse(Scheduled { at, event, .. })) = self.queue.pop() else {
                return Err("nothing is left to happen, and the run has not ended".to_owned());
            };
            if at > LONGEST || events > MOST_EVENTS {
                return Err(format!("the run has not ended after {at:?} and {events} events"));
            }
            self.now = at;
            self.happen(event)?;
        }
        Ok(())
    }

    fn happen(&mut self, event: Event) -> Result<(), String> {
        match event {
            Event::Query(from, query) => return self.query(from, query),
            Event::Answer(to, reply) => return self.answered(to, Some(reply)),
            Event::Timeout(to) => return self.answered(to, None),
            Event::Progress(progress) => return self.carry(Input::Progress(progress)),
            Event::Token(number) => {
                let evaluator = &self.evaluators[number];
                let (name, here) = (evaluator.name.clone(), evaluator.alive && !evaluator.cut);
                return self.token(name, here);
            }
            Event::Learners(number, epoch) => {
                let here = self.learner.alive.is_some() && !self.evaluators[number].cut;
                let seen = BTreeSet::from_iter(here.then_some(self.learner.incarnation));
                self.sees_learners(number, epoch, seen);
            }
            Event::Turn(number, epoch) => self.turn(number, epoch),
            Event::Played(number, epoch) => return self.played(number, epoch),
            Event::Train(epoch) => return self.train(epoch),
            Event::Written(epoch) => return self.written(epoch),
            Event::Appended(epoch) => return self.appended(epoch),
            Event::Tick(epoch) => return self.tick(epoch),
            Event::StartLearner => return self.start_learner(),
            Event::Stranger => {
                self.again(|faults| faults.strangers, Event::Stranger);
                return self.stranger();
            }
            Event::CrashLearner => {
                self.record(|| "the learner crashes".to_owned());
                self.crash_learner();
                self.again(|faults| faults.learner_crashes, Event::CrashLearner);
                let pause = Duration::from_millis(self.rng.random_range(10..15_000));
                self.after(pause, Event::StartLearner);
            }
            Event::CrashEvaluator(number) => {
                self.record(|| format!("e{number} crashes"));
                self.crash_evaluator(number);
                self.again(|it| it.evaluator_crashes, Event::CrashEvaluator(number));
            }
            Event::StartEvaluator(number) => self.start_evaluator(number),
            Event::LeaveEvaluator(number) => {
                self.record(|| format!("e{number} leaves"));
                self.leave_evaluator(number);
                self.again(|it| it.evaluator_leaves, Event::LeaveEvaluator(number));
            }
            Event::Cut(number) => {
                self.cut(number, true);
                let pause = Duration::from_millis(self.rng.random_range(100..30_000));
                self.after(pause, Event::Heal(number));
                self.again(|faults| faults.partitions, Event::Cut(number));
            }
            Event::Heal(number) => self.cut(number, false),
            Event::DiskFails(fails) => {
                self.record(|| format!("the disk fails: {fails}"));
                self.disk.fails = fails;
                match fails {
                    true => {
                        let pause = Duration::from_millis(self.rng.random_range(100..30_000));
                        self.after(pause, Event::DiskFails(false));
                    }
                    false => self.again(|it| it.disk_failures, Event::DiskFails(true)),
                }
            }
        }
        Ok(())
    }

    fn token(&mut self, evaluator: Name, here: bool) -> Result<(), String> {
        self.carry(if here { Input::Joined(evaluator) } else { Input::Left(evaluator) })
    }

    fn schedule_faults(&mut self) {
        for number in 0..self.evaluators.len() {
            self.again(|it| it.evaluator_crashes, Event::CrashEvaluator(number));
            self.again(|it| it.evaluator_leaves, Event::LeaveEvaluator(number));
            self.again(|it| it.partitions, Event::Cut(number));
        }
        self.again(|it| it.learner_crashes, Event::CrashLearner);
        self.again(|it| it.disk_failures, Event::DiskFails(true));
        self.again(|it| it.strangers, Event::Stranger);
    }

    /// Schedules the next fault of a kind, unless the time of faults is over.
    fn again(&mut self, mean: impl Fn(&crate::settings::Faults) -> Option<Duration>, event: Event) {
        if let Some(mean) = mean(&self.settings.faults) {
            let pause = mean.mul_f64(self.rng.random_range(0.1..2.0));
            if self.now + pause < self.settings.faults.until {
                self.after(pause, event);
            }
        }
    }

    fn stranger(&mut self) -> Result<(), String> {
        let query = strangers::query(self);
        self.query(Sender::STRANGER, query)?;
        if self.rng.random_bool(0.2) {
            let (name, here) =
                (name(&format!("stranger-{}", self.rng.random_range(0..5))), self.rng.random());
            return self.token(name, here);
        }
        Ok(())
    }

    pub fn instant(&self) -> Instant {
        self.start + self.now
    }

    pub fn after(&mut self, pause: Duration, event: Event) {
        self.number += 1;
        let (at, number) = (self.now + pause, self.number);
        self.queue.push(Reverse(Scheduled { at, number, event }));
    }

    pub fn record(&mut self, line: impl FnOnce() -> String) {
        if let Some(trace) = &mut self.trace {
            trace.push(format!("{:>10.3} s  {}", self.now.as_secs_f64(), line()));
        }
    }

    /// A snapshot has the weights of a run without faults, if all evaluators compute the same bits.
    pub fn check_snapshot(&self, step: u64, weights: Hash) -> Result<(), String> {
        let expected = self.reference.snapshots.get(&step);
        match self.settings.faults.other_bits || expected == Some(&weights) {
            true => Ok(()),
            false => Err(format!("the snapshot of step {step} depends on the schedule")),
        }
    }

    fn check_end(&mut self, end: End) -> Result<(), String> {
        match end {
            End::Complete => {}
            // No evaluator that has the environment was there for long.
            End::Unscored => return Ok(()),
            End::OtherWeights(error) => return Err(error.to_string()),
        }
        self.disk.check()?;
        for &(step, seed) in &self.acknowledged_scores {
            if self.disk.score(step, seed).is_none() {
                return Err(format!("the acknowledged score of step {step}, seed {seed} is lost"));
            }
        }
        let seeds = match &self.settings.online {
            Some(online) => self.disk.online(self.settings.offline_steps, online.lag)?.seeds,
            None => Vec::new(),
        };
        for seed in &self.acknowledged_episodes {
            if !seeds.iter().any(|(recorded, hash)| recorded == seed && hash.is_some()) {
                return Err(format!("the acknowledged episode with seed {seed} is lost"));
            }
        }
        if !self.settings.faults.other_bits && self.last_state() != Some(self.reference.last) {
            return Err("the last state depends on the schedule".to_owned());
        }
        self.check_scores()
    }

    /// Every episode has its score, unless it was given up.
    fn check_scores(&self) -> Result<(), String> {
        let Some(alive) = &self.learner.alive else { return Ok(()) };
        let missing = alive.service.gauges().missing;
        let steps = self.settings.schedule.evaluations();
        let expected = steps as usize * self.settings.episodes as usize;
        if self.disk.scores.len() + missing != expected {
            let scores = self.disk.scores.len();
            return Err(format!("{scores} scores and {missing} given up are not {expected}"));
        }
        if self.settings.faults.other_bits {
            return Ok(());
        }
        for line in &self.disk.scores {
            let weights = self.reference.snapshots[&line.step];
            if line.episode() != crate::arithmetic::score(&weights, line.seed, 0) {
                return Err(format!("step {}, seed {} has another score", line.step, line.seed));
            }
        }
        Ok(())
    }
}
