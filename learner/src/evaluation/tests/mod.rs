//! The scoreboard under a clock of the test's own: two evaluations, and what evaluators say.

mod jobs;
mod leases;
mod reports;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use quad_protocol::{EpisodeScore, Hash, Job, Name, Progress, ScoreReport};
use quad_run::folder::SavedScores;

use super::outcomes::Recorded;
use super::{Claim, Claimed, HandedBack, Lost, Refusal, Rules, Scoreboard, Validated};

const LEASE: Duration = Duration::from_secs(10);
const INCARNATION: u64 = 77;

struct Bench {
    board: Scoreboard,
    /// How many evaluators there are.
    present: usize,
    start: Instant,
}

fn hash(step: u64) -> Hash {
    Hash::of(&step.to_le_bytes())
}

impl Bench {
    /// Evaluations of steps 1000 and 2000, seven episodes each: seeds 1..=7 and 11..=17.
    fn new() -> Self {
        Self::after(BTreeMap::new())
    }

    /// A scoreboard of a later incarnation of the run.
    fn after(earlier: BTreeMap<u64, SavedScores>) -> Self {
        let rules = Rules {
            run: name("run"),
            incarnation: INCARNATION,
            task: quad_dataset::environment::find("hopper").unwrap().into(),
            environment_seed: 5,
            job_episodes: [5, 20],
            lease: LEASE,
        };
        let mut board = Scoreboard::new(rules, earlier);
        board.add_evaluation(2000, hash(2000), &Vec::from_iter(11..=17)).unwrap();
        board.add_evaluation(1000, hash(1000), &Vec::from_iter(1..=7)).unwrap();
        Self { board, present: 2, start: Instant::now() }
    }

    fn at(&self, seconds: u64) -> Instant {
        self.start + Duration::from_secs(seconds)
    }

    fn claim(&mut self, evaluator: &str, attempt: u64, seconds: u64) -> Claimed {
        let now = self.at(seconds);
        let environments = ["ant".to_owned(), "hopper".to_owned()];
        self.board.claim(
            Claim {
                evaluator: &name(evaluator),
                attempt,
                environments: &environments,
                present: self.present,
            },
            now,
        )
    }

    fn job(&mut self, evaluator: &str, seconds: u64) -> Job {
        // Another attempt at another time.
        match self.claim(evaluator, seconds, seconds) {
            Claimed::Job { job, .. } => job,
            other => panic!("{other:?} at {seconds} s"),
        }
    }

    fn progress(&mut self, progress: &Progress, seconds: u64) -> Result<bool, Refusal> {
        let now = self.at(seconds);
        self.board.progress(progress, now)
    }

    /// Hands a job back; `failed` is the second at which it failed, if it did.
    fn hand_back(&mut self, evaluator: &str, job: &Job, failed: Option<u64>) -> Option<HandedBack> {
        let failed = failed.map(|seconds| self.at(seconds));
        self.board.hand_back(&name(evaluator), job.id, failed)
    }

    fn gone(&mut self, evaluator: &str, seconds: u64) -> Lost {
        let now = self.at(seconds);
        self.board.evaluator_gone(&name(evaluator), now)
    }

    fn keep(&mut self, report: &ScoreReport, seconds: u64) {
        let now = self.at(seconds);
        self.board.keep(report, now);
    }

    fn expire(&mut self, seconds: u64) -> usize {
        let now = self.at(seconds);
        self.board.expire(now).jobs
    }

    /// As the thread `scores` does: validate, then record.
    fn deliver(&mut self, report: &ScoreReport) -> Result<(Validated, Recorded), Refusal> {
        let validated = self.board.validate(report)?;
        let recorded = self.board.record(report, &validated.new);
        Ok((validated, recorded))
    }
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// An episode of Hopper.
fn score(seed: u64, episode_return: f64) -> EpisodeScore {
    let hopper = quad_dataset::environment::find("hopper").unwrap();
    EpisodeScore {
        seed,
        episode_return,
        length: 100,
        score: hopper.normalized_score(episode_return),
    }
}

/// Some of a job's scores.
fn report(job: &Job, evaluator: &str, episodes: Vec<EpisodeScore>) -> ScoreReport {
    ScoreReport::new(job, name(evaluator), name("f32"), episodes)
}

/// All of them.
fn full_report(job: &Job, evaluator: &str) -> ScoreReport {
    report(job, evaluator, job.seeds.iter().map(|&seed| score(seed, 500.0)).collect())
}

/// Progress of a job after this many environment steps.
fn progress(job: &Job, evaluator: &str, steps_done: u64) -> Progress {
    Progress {
        steps_done,
        environment_steps: 10,
        episodes: 1,
        ..Progress::new(job, name(evaluator))
    }
}
