//! One job: all of its episodes as one batch, on a thread of its own.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_dataset::environment::{self, EnvironmentSpec, UnknownEnvironment};
use quad_policy::{ActionNoise, Policy};
use quad_protocol::{EpisodeScore, Job, Name};

use crate::metrics::{JobOutcome, Metrics};
use crate::rollout::{EpisodeOutcome, Rollout};

/// Most rows (episodes × candidates) of one network call; they bound an evaluator's memory. The paper's job has 100.
const MAX_ROWS: usize = 65_536;

/// Why a job is not run.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// It belongs to another run than the one whose learner was asked.
    #[error("it is for run {0}")]
    Run(Name),
    /// It is empty, or larger than this evaluator runs.
    #[error("it has {episodes} episodes with {candidates} candidates; 1 to {MAX_ROWS} in all are run")]
    Size {
        /// Its episodes.
        episodes: usize,
        /// Candidates per state.
        candidates: u32,
    },
    /// Its environment is not known.
    #[error(transparent)]
    Environment(#[from] UnknownEnvironment),
}

impl JobError {
    /// The reason as a metric's label.
    pub fn label(&self) -> &'static str {
        match self {
            JobError::Run(_) => "other_run",
            JobError::Size { .. } => "job_size",
            JobError::Environment(_) => "schema",
        }
    }
}

/// Checks a job from the wire; gives its environment.
pub fn check(job: &Job, run: &Name) -> Result<&'static EnvironmentSpec, JobError> {
    if job.run != *run {
        return Err(JobError::Run(job.run.clone()));
    }
    let (episodes, candidates) = (job.seeds.len(), job.candidates);
    if !(1..=MAX_ROWS).contains(&episodes.saturating_mul(candidates as usize)) {
        return Err(JobError::Size { episodes, candidates });
    }
    Ok(environment::find(&job.environment)?)
}

/// What the thread that runs a job and the task that watches it share.
#[derive(Default)]
struct Shared {
    cancelled: AtomicBool,
    episodes_done: AtomicU32,
}

/// A job that is being run. Dropped before its end, it stops within one step of the batch and counts as abandoned.
pub struct Running {
    shared: Arc<Shared>,
    metrics: Metrics,
    started: Instant,
    thread: Option<tokio::task::JoinHandle<anyhow::Result<Option<Vec<EpisodeOutcome>>>>>,
}

impl Running {
    /// Starts the episodes of a checked job.
    pub fn start(job: &Job, spec: &'static EnvironmentSpec, policy: Arc<dyn Policy>, metrics: Metrics) -> Running {
        let shared = Arc::new(Shared::default());
        let thread = tokio::task::spawn_blocking({
            let (shared, metrics, job) = (shared.clone(), metrics.clone(), job.clone());
            // On a thread of the pool: else each parallel part of each step would wake one up and wait for it.
            move || rayon::scope(|_| roll_out(spec, &job, policy.as_ref(), &shared, &metrics))
        });
        Running { shared, metrics, started: Instant::now(), thread: Some(thread) }
    }

    /// Episodes that have ended.
    pub fn episodes_done(&self) -> u32 {
        self.shared.episodes_done.load(Relaxed)
    }

    /// Waits up to `patience` for the end; `None` if it is not there yet.
    pub async fn finished_within(&mut self, patience: Duration) -> Option<anyhow::Result<Vec<EpisodeScore>>> {
        let thread = self.thread.as_mut()?;
        let joined = tokio::time::timeout(patience, thread).await.ok()?;
        self.thread = None;
        Some(match joined {
            Ok(Ok(Some(outcomes))) => {
                self.metrics.job_duration.observe(self.started.elapsed().as_secs_f64());
                Ok(outcomes.iter().map(episode_score).collect())
            }
            Ok(Ok(None)) => Err(anyhow::anyhow!("it was cancelled")),
            Ok(Err(error)) => Err(error),
            Err(error) => Err(error.into()),
        })
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if self.thread.is_some() {
            self.shared.cancelled.store(true, Relaxed);
            self.metrics.job(JobOutcome::Abandoned);
        }
    }
}

/// Runs all episodes to their end, or gives `None` when cancelled. Fails if the policy cannot act.
fn roll_out(
    spec: &'static EnvironmentSpec,
    job: &Job,
    policy: &dyn Policy,
    shared: &Shared,
    metrics: &Metrics,
) -> anyhow::Result<Option<Vec<EpisodeOutcome>>> {
    let mut rollout = Rollout::new(spec, job.instance, &job.seeds, ActionNoise::new)?;
    let candidates = job.candidates as usize;
    while !rollout.is_done() {
        if shared.cancelled.load(Relaxed) {
            return Ok(None);
        }
        let steps = rollout.environment_steps();
        let times = [rollout.select_time(), rollout.physics_time()];
        let done = rollout.episodes_done();
        rollout
            .step(|observations, noise, actions| policy.act(observations, candidates, noise, actions))
            .context("the policy cannot act")?;
        metrics.environment_steps.inc_by(rollout.environment_steps() - steps);
        metrics.select_seconds.inc_by((rollout.select_time() - times[0]).as_secs_f64());
        metrics.physics_seconds.inc_by((rollout.physics_time() - times[1]).as_secs_f64());
        let ended = rollout.episodes_done() - done;
        metrics.episodes.inc_by(ended as u64);
        shared.episodes_done.fetch_add(ended as u32, Relaxed);
    }
    Ok(Some(rollout.into_outcomes()))
}

fn episode_score(outcome: &EpisodeOutcome) -> EpisodeScore {
    let EpisodeOutcome { seed, episode_return, length, score, .. } = *outcome;
    EpisodeScore { seed, episode_return, length, score }
}
