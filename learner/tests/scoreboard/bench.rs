//! A scoreboard with two evaluations, and its clock.

use std::time::{Duration, Instant};

use quad_learner::scoreboard::{Claim, HandedBack, Lost, Recorded, Refusal, Rules, Scoreboard, Screened};
use quad_protocol::{Hash, Job, JobReply, Progress, ScoreReport};

use crate::common::name;

pub const LEASE: Duration = Duration::from_secs(10);
pub const INCARNATION: u64 = 77;

pub struct Bench {
    pub board: Scoreboard,
    /// How many evaluators there are.
    pub present: usize,
    start: Instant,
}

pub fn hash(step: u64) -> Hash {
    Hash::of(&step.to_le_bytes())
}

impl Bench {
    /// Evaluations of steps 1000 and 2000, seven episodes each: seeds 1..=7 and 11..=17.
    pub fn new() -> Self {
        Self::with_audit(0.0)
    }

    pub fn with_audit(audit: f64) -> Self {
        let rules = Rules {
            run: name("run"),
            incarnation: INCARNATION,
            task: quad_dataset::environment::find("hopper").unwrap().into(),
            instance: 5,
            candidates: 10,
            job_episodes: [5, 20],
            lease: LEASE,
            audit,
        };
        let mut board = Scoreboard::new(rules);
        board.add_evaluation(2000, hash(2000), &Vec::from_iter(11..=17)).unwrap();
        board.add_evaluation(1000, hash(1000), &Vec::from_iter(1..=7)).unwrap();
        Self { board, present: 2, start: Instant::now() }
    }

    pub fn at(&self, seconds: u64) -> Instant {
        self.start + Duration::from_secs(seconds)
    }

    pub fn claim(&mut self, evaluator: &str, attempt: u64, seconds: u64) -> JobReply {
        let now = self.at(seconds);
        let environments = ["ant".to_owned(), "hopper".to_owned()];
        self.board.claim(
            Claim {
                evaluator: &name(evaluator),
                attempt,
                environments: &environments,
                precision: &name("f32"),
                present: self.present,
            },
            now,
        )
    }

    pub fn job(&mut self, evaluator: &str, seconds: u64) -> Job {
        // Another attempt at another time.
        match self.claim(evaluator, seconds, seconds) {
            JobReply::Job(job) => job,
            other => panic!("{other:?} at {seconds} s"),
        }
    }

    pub fn progress(&mut self, progress: &Progress, seconds: u64) -> Result<(), Refusal> {
        let now = self.at(seconds);
        self.board.progress(progress, now)
    }

    /// At some second, if the job failed.
    pub fn hand_back(&mut self, evaluator: &str, job: &Job, failed: Option<u64>) -> Option<HandedBack> {
        let failed = failed.map(|seconds| self.at(seconds));
        self.board.hand_back(&name(evaluator), job.id, &job.lease, failed)
    }

    pub fn gone(&mut self, evaluator: &str, seconds: u64) -> Lost {
        let now = self.at(seconds);
        self.board.evaluator_gone(&name(evaluator), now)
    }

    pub fn keep(&mut self, report: &ScoreReport, seconds: u64) {
        let now = self.at(seconds);
        self.board.keep(report, now);
    }

    pub fn expire(&mut self, seconds: u64) -> usize {
        let now = self.at(seconds);
        self.board.expire(now).jobs
    }

    /// As the hub does: screen, then record.
    pub fn deliver(&mut self, report: &ScoreReport) -> Result<(Screened, Recorded), Refusal> {
        let screened = self.board.screen(report)?;
        let recorded = self.board.record(report, &screened.new);
        Ok((screened, recorded))
    }
}
