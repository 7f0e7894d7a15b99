//! Virtual time, the network, and the order of all events. Every choice follows from one seed.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use quad_learner::service::{Answer, End, Input};
use quad_protocol::{Hash, JobRequest, Name, Piece, Progress, ScoreReport};
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
    pub query: u32,
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
    Service(Answer),
    Weights(u64, Hash),
}

/// Names of evaluators are followed by the number of their start, learners' events by theirs.
#[derive(Clone, Debug)]
pub enum Event {
    Query(Sender, Box<Query>),
    Answer(Sender, Box<Reply>),
    /// The time to answer an evaluator's query may be over.
    Timeout(usize, u32),
    Progress(Box<Progress>),
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
    /// All evaluators are gone for ever.
    Desert,
    DiskFails(bool),
    Stranger,
}

pub struct World {
    pub rng: StdRng,
    pub settings: Settings,
    pub reference: Reference,
    start: Instant,
    pub now: Duration,
    /// Events by time and number.
    queue: BTreeMap<(Duration, u64), Event>,
    number: u64,
    pub learner: LearnerProcess,
    pub evaluators: Vec<EvaluatorProcess>,
    pub disk: Disk,
    pub acknowledged_scores: BTreeSet<(u64, u64)>,
    pub acknowledged_episodes: BTreeSet<u64>,
    pub trained: bool,
    /// True once all evaluators are gone for ever.
    pub deserted: bool,
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
            queue: BTreeMap::new(),
            number: 0,
            learner: LearnerProcess::default(),
            evaluators: Vec::new(),
            disk: Disk::default(),
            acknowledged_scores: BTreeSet::new(),
            acknowledged_episodes: BTreeSet::new(),
            trained: false,
            deserted: false,
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
            let Some(((time, _), event)) = self.queue.pop_first() else {
                return Err("nothing is left to happen, and the run has not ended".to_owned());
            };
            if time > LONGEST || events > MOST_EVENTS {
                return Err(format!("the run has not ended after {time:?} and {events} events"));
            }
            self.now = time;
            self.happen(event)?;
        }
        Ok(())
    }

    fn happen(&mut self, event: Event) -> Result<(), String> {
        match event {
            Event::Query(from, query) => return self.query(from, *query),
            Event::Answer(to, reply) => return self.answered(to, Some(*reply)),
            Event::Timeout(number, epoch) => return self.timeout(number, epoch),
            Event::Progress(progress) => return self.carry(Input::Progress(*progress)),
            Event::Token(number) => {
                let evaluator = &self.evaluators[number];
                let (name, here) = (evaluator.name.clone(), evaluator.alive && !evaluator.cut);
                return self.token(name, here);
            }
            Event::Learners(number, epoch) => {
                let here = self.learner.alive.is_some() && !self.evaluators[number].cut;
                let seen = BTreeSet::from_iter(here.then_some(self.learner.incarnation));
                return self.sees_learners(number, epoch, seen);
            }
            Event::Turn(number, epoch) => return self.turn(number, epoch),
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
                self.again(|faults| faults.evaluator_crashes, Event::CrashEvaluator(number));
            }
            Event::StartEvaluator(number) => self.start_evaluator(number),
            Event::LeaveEvaluator(number) => {
                self.record(|| format!("e{number} leaves"));
                self.leave_evaluator(number)?;
                self.again(|faults| faults.evaluator_leaves, Event::LeaveEvaluator(number));
            }
            Event::Cut(number) => {
                self.cut(number, true);
                let pause = Duration::from_millis(self.rng.random_range(100..30_000));
                self.after(pause, Event::Heal(number));
                self.again(|faults| faults.partitions, Event::Cut(number));
            }
            Event::Heal(number) => self.cut(number, false),
            Event::Desert => {
                self.record(|| "all evaluators are gone for ever".to_owned());
                self.deserted = true;
                (0..self.evaluators.len()).for_each(|number| self.crash_evaluator(number));
            }
            Event::DiskFails(fails) => {
                self.record(|| format!("the disk fails: {fails}"));
                self.disk.fails = fails;
                match fails {
                    true => {
                        let pause = Duration::from_millis(self.rng.random_range(100..30_000));
                        self.after(pause, Event::DiskFails(false));
                    }
                    false => self.again(|faults| faults.disk_failures, Event::DiskFails(true)),
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
            self.again(|faults| faults.evaluator_crashes, Event::CrashEvaluator(number));
            self.again(|faults| faults.evaluator_leaves, Event::LeaveEvaluator(number));
            self.again(|faults| faults.partitions, Event::Cut(number));
        }
        self.again(|faults| faults.learner_crashes, Event::CrashLearner);
        self.again(|faults| faults.disk_failures, Event::DiskFails(true));
        self.again(|faults| faults.strangers, Event::Stranger);
        if let Some(desertion) = self.settings.faults.desertion {
            self.after(desertion, Event::Desert);
        }
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
        self.queue.insert((self.now + pause, self.number), event);
    }

    pub fn record(&mut self, line: impl FnOnce() -> String) {
        if let Some(trace) = &mut self.trace {
            trace.push(format!("{:>10.3} s  {}", self.now.as_secs_f64(), line()));
        }
    }
}
