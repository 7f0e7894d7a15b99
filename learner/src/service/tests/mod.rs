//! Tests of messages, times and numbers; that no schedule of messages, crashes and disks loses or
//! doubles anything is the simulation's.

mod jobs;
mod leases;
mod results;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use quad_protocol::{
    EpisodeScore, Exploration, Hash, Job, JobReply, JobRequest, Name, Progress, ScoreReport,
};
use quad_run::config::Schedule;

use super::{Answer, Count, Input, Opening, Order, Rules, Service};

const LEASE: Duration = Duration::from_secs(10);
const INCARNATION: u64 = 77;

/// A service whose queries are numbers, and its clock.
struct Bench {
    service: Service<u32>,
    start: Instant,
}

impl Bench {
    /// Evaluations of steps 1000 and 2000, of seven episodes each, for two evaluators.
    fn new() -> Self {
        let mut bench = Self::empty(7);
        bench.connect(2);
        bench.open_evaluation(1000);
        bench.open_evaluation(2000);
        bench
    }

    /// A run without evaluations.
    fn empty(episodes: u32) -> Self {
        let start = Instant::now();
        let rules = Rules {
            run: name("run"),
            incarnation: INCARNATION,
            task: quad_dataset::environment::find("hopper").unwrap().into(),
            seed: 5,
            dims: (11, 3),
            episodes,
            schedule: Schedule { start: 0, steps: 3500, eval_interval: 1000 },
            job_episodes: [5, 20],
            lease: LEASE,
        };
        Self { service: Service::new(rules, BTreeMap::new(), &[], start), start }
    }

    fn handle(&mut self, input: Input<u32>, seconds: u64) -> Vec<Order<u32>> {
        self.service.handle(input, self.start + Duration::from_secs(seconds))
    }

    fn open_evaluation(&mut self, step: u64) -> Vec<Order<u32>> {
        self.handle(Input::Snapshot { step, weights: hash(step) }, 0)
    }

    /// Opens an online episode with the snapshot of step 500 and the seed 100 + `episode`.
    fn open_online(&mut self, episode: u64) {
        let exploration = Exploration::Policy { noise: 0.1 };
        let opening = Opening { episode, step: 500, seed: 100 + episode, exploration };
        self.handle(Input::Opened(opening, hash(500)), 0);
    }

    /// Connects so many evaluators, beside those of the tests.
    fn connect(&mut self, evaluators: usize) {
        for number in 0..evaluators {
            self.handle(Input::Joined(name(&format!("connected-{number}"))), 0);
        }
    }

    fn ask(&mut self, request: JobRequest, seconds: u64) -> JobReply {
        let orders = self.handle(Input::Job(0, request), seconds);
        let reply = orders.into_iter().find_map(|order| match order {
            Order::Reply(_, Answer::Job(reply)) => Some(reply),
            _ => None,
        });
        reply.unwrap()
    }

    fn claim(&mut self, evaluator: &str, attempt: u64, seconds: u64) -> JobReply {
        let environments = vec!["hopper".to_owned()];
        let evaluator = name(evaluator);
        self.ask(JobRequest::Claim { evaluator, attempt, environments }, seconds)
    }

    fn job(&mut self, evaluator: &str, seconds: u64) -> Job {
        // Another attempt at another time.
        match self.claim(evaluator, seconds, seconds) {
            JobReply::Job(job) => job,
            reply => panic!("{reply:?} at {seconds} s"),
        }
    }

    /// True if the learner takes the job back.
    fn hand_back(&mut self, evaluator: &str, job: u64, failed: Option<&str>, seconds: u64) -> bool {
        let (evaluator, failed) = (name(evaluator), failed.map(str::to_owned));
        let reply = self.ask(JobRequest::HandBack { evaluator, job, failed }, seconds);
        reply == JobReply::HandedBack { incarnation: INCARNATION, accepted: true }
    }

    /// The label of the refusal, if it is refused.
    fn progress(&mut self, progress: &Progress, seconds: u64) -> Option<&'static str> {
        rejected(&self.handle(Input::Progress(progress.clone()), seconds))
    }

    /// Lets time pass. Returns the number of jobs whose lease has ended.
    fn expire(&mut self, seconds: u64) -> usize {
        let orders = self.handle(Input::Tick { training_waits: false }, seconds);
        let expired = orders.iter().find_map(|order| match order {
            Order::Count(Count::Jobs("expired", jobs)) => Some(*jobs),
            _ => None,
        });
        expired.unwrap_or(0)
    }

    /// Lets the disk take what has arrived. Returns the other orders.
    fn flush(&mut self) -> Vec<Order<u32>> {
        let (mut done, mut orders) = (Vec::new(), self.handle(Input::Flush, 0));
        while let Some(order) = orders.pop() {
            orders.extend(match order {
                Order::Decode(frame) => {
                    let episode = frame.decode();
                    self.handle(Input::Decoded(frame, episode), 0)
                }
                Order::Append { .. } => self.handle(Input::Appended([Ok(()), Ok(())]), 0),
                order => {
                    done.push(order);
                    Vec::new()
                }
            });
        }
        done
    }

    fn deliver(&mut self, report: ScoreReport) -> Vec<Order<u32>> {
        self.handle(Input::Scores(0, report), 0);
        self.flush()
    }

    fn pending(&self) -> usize {
        self.service.gauges().pending
    }
}

fn rejected(orders: &[Order<u32>]) -> Option<&'static str> {
    orders.iter().find_map(|order| match order {
        Order::Count(Count::Rejected(label)) => Some(*label),
        _ => None,
    })
}

fn lines(orders: Vec<Order<u32>>) -> Vec<String> {
    let line = |order| match order {
        Order::Tell(line) => Some(line),
        _ => None,
    };
    orders.into_iter().filter_map(line).collect()
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn hash(step: u64) -> Hash {
    Hash::new(&step.to_le_bytes())
}

fn score(seed: u64, episode_return: f64) -> EpisodeScore {
    let hopper = quad_dataset::environment::find("hopper").unwrap();
    let score = hopper.normalized_score(episode_return);
    EpisodeScore { seed, episode_return, length: 100, score }
}

/// Scores of all episodes of a job.
fn report(job: &Job, evaluator: &str) -> ScoreReport {
    let episodes = job.seeds.iter().map(|&seed| score(seed, 500.0)).collect();
    ScoreReport::new(job, name(evaluator), name("f32"), episodes)
}

/// Progress of a job after this many environment steps.
fn progress(job: &Job, evaluator: &str, steps_done: u64) -> Progress {
    Progress { steps_done, ..Progress::new(job, name(evaluator)) }
}
