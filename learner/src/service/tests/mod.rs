//! Tests of the scoreboard under a simulated clock.

mod deliveries;
mod jobs;
mod leases;
mod online;
mod reports;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use quad_protocol::{EpisodeScore, Hash, Job, Name, Progress, ScoreReport};
use quad_run::config::Schedule;
use quad_run::folder::SavedScores;

use super::outcomes::{Claim, Claimed, Lost, OtherWeights};
use super::refusal::Refusal;
use super::scoreboard::{Rules, Scoreboard};
use super::validate::Validated;

const LEASE: Duration = Duration::from_secs(10);
const INCARNATION: u64 = 77;

/// Rules of a run with evaluations of so many episodes.
fn rules(episodes: u32) -> Rules {
    Rules {
        run: name("run"),
        incarnation: INCARNATION,
        task: quad_dataset::environment::find("hopper").unwrap().into(),
        seed: 5,
        dims: (11, 3),
        episodes,
        schedule: Schedule { start: 0, steps: 3500, eval_interval: 1000 },
        job_episodes: [5, 20],
        lease: LEASE,
    }
}

struct Bench {
    board: Scoreboard,
    /// Number of connected evaluators.
    present: usize,
    start: Instant,
    /// Scores of the last evaluation that a report completed.
    completed: Option<Vec<EpisodeScore>>,
}

fn hash(step: u64) -> Hash {
    Hash::new(&step.to_le_bytes())
}

impl Bench {
    /// Evaluations of steps 1000 and 2000, seven episodes each: seeds 1..=7 and 11..=17.
    fn new() -> Self {
        Self::after(BTreeMap::new())
    }

    /// A scoreboard of a later incarnation of the run.
    fn after(earlier: BTreeMap<u64, SavedScores>) -> Self {
        let mut board = Scoreboard::new(Arc::new(rules(7)), earlier);
        board.add_evaluation(2000, hash(2000), &Vec::from_iter(11..=17)).unwrap();
        board.add_evaluation(1000, hash(1000), &Vec::from_iter(1..=7)).unwrap();
        Self { board, present: 2, start: Instant::now(), completed: None }
    }

    fn at(&self, seconds: u64) -> Instant {
        self.start + Duration::from_secs(seconds)
    }

    fn claim(&mut self, evaluator: &str, attempt: u64, seconds: u64) -> Claimed {
        let (evaluator, present, now) = (&name(evaluator), self.present, self.at(seconds));
        self.board.claim(Claim { evaluator, attempt, fits: true, present }, now)
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

    /// Hands a job back, which may have failed at some second.
    fn hand_back(
        &mut self,
        evaluator: &str,
        job: &Job,
        failed: Option<u64>,
    ) -> Option<(u64, Vec<(u64, u64)>)> {
        let failed = failed.map(|seconds| self.at(seconds));
        let handed_back = self.board.hand_back(&name(evaluator), job.id, failed);
        handed_back.map(|(job, given_up)| (job.step, given_up))
    }

    fn leave(&mut self, evaluator: &str, seconds: u64) -> Lost {
        let now = self.at(seconds);
        self.board.release(&name(evaluator), Some(now))
    }

    fn extend_lease(&mut self, report: &ScoreReport, seconds: u64) {
        let now = self.at(seconds);
        let ScoreReport { evaluator, incarnation, job, .. } = report;
        self.board.extend_lease(evaluator, *incarnation, *job, now);
    }

    fn expire(&mut self, seconds: u64) -> usize {
        let now = self.at(seconds);
        self.board.expire(now).jobs
    }

    /// Validates and records a report. Returns the numbers of its new and duplicate scores, and of
    /// completed jobs.
    fn deliver(&mut self, report: &ScoreReport) -> Result<(usize, u32, usize), Refusal> {
        let Validated { new, duplicates } = self.board.validate(report)?;
        let recorded = self.board.record(report, &new);
        self.completed = recorded.evaluation_completed.or(self.completed.take());
        Ok((new.len(), duplicates, recorded.jobs_completed))
    }
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn score(seed: u64, episode_return: f64) -> EpisodeScore {
    let hopper = quad_dataset::environment::find("hopper").unwrap();
    let score = hopper.normalized_score(episode_return);
    EpisodeScore { seed, episode_return, length: 100, score }
}

fn report(job: &Job, evaluator: &str, episodes: Vec<EpisodeScore>) -> ScoreReport {
    ScoreReport::new(job, name(evaluator), name("f32"), episodes)
}

/// All scores of a job.
fn full_report(job: &Job, evaluator: &str) -> ScoreReport {
    report(job, evaluator, job.seeds.iter().map(|&seed| score(seed, 500.0)).collect())
}

/// Progress of a job after this many environment steps.
fn progress(job: &Job, evaluator: &str, steps_done: u64) -> Progress {
    Progress { steps_done, ..Progress::new(job, name(evaluator)) }
}
