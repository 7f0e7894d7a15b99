//! One job: all of its episodes as one batch, on a thread of its own.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_policy::{EpisodeState, Policy, PolicyError};
use quad_protocol::{EpisodeScore, Job};

use crate::metrics::{JobOutcome, Metrics};
use crate::sim::{EnvironmentError, Environments, EpisodeOutcome, Rollout};

/// Most episodes of a job: each is a simulation. A learner gives forty at most.
const MAX_EPISODES: usize = 256;
/// Most memory of one network call, bytes: far more than the paper's few megabytes, and far less
/// than an evaluator's container has (1 GiB, in docker-compose.yml), which also holds snapshots and
/// the policy.
const MAX_BYTES: u64 = 256 << 20;

/// Why the evaluator does not run a job.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    #[error("it has {0} episodes, but must have from 1 to {MAX_EPISODES}")]
    Size(usize),
    #[error("each of its steps takes {0} bytes of memory, more than {MAX_BYTES}")]
    Memory(u64),
    #[error("its episodes did not end within {} s", Job::LONGEST.as_secs())]
    TooLong,
    #[error("this evaluator has no environment \"{0}\"")]
    Environment(String),
    /// The snapshot is for another environment, or has other sizes.
    #[error("the snapshot is for {found}, the job's environment is {wanted}")]
    OtherEnvironment { found: String, wanted: String },
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

impl JobError {
    /// The reason as a metric's label.
    pub fn label(&self) -> &'static str {
        match self {
            JobError::Size(_) | JobError::Memory(_) => "job_size",
            JobError::TooLong => "too_long",
            JobError::Environment(_) | JobError::OtherEnvironment { .. } => "environment",
            JobError::Policy(_) => "tensors",
        }
    }
}

/// Checks a job from the learner.
pub fn check(job: &Job, environments: &dyn Environments) -> Result<(), JobError> {
    let episodes = job.seeds.len();
    if !(1..=MAX_EPISODES).contains(&episodes) {
        return Err(JobError::Size(episodes));
    }
    match environments.names().contains(&job.environment) {
        true => Ok(()),
        false => Err(JobError::Environment(job.environment.clone())),
    }
}

/// Checks that a job with its policy does not take too much memory.
pub fn check_memory(job: &Job, policy: &dyn Policy) -> Result<(), JobError> {
    let bytes = policy.memory(job.seeds.len());
    if bytes > MAX_BYTES { Err(JobError::Memory(bytes)) } else { Ok(()) }
}

/// The state that the thread of a job and the task that watches it share.
#[derive(Default)]
struct Shared {
    canceled: AtomicBool,
    episodes_done: AtomicU32,
    steps_done: AtomicU64,
}

/// A running job. Dropped before its end, it stops within one step of the batch and counts as
/// abandoned.
pub struct Running {
    shared: Arc<Shared>,
    metrics: Metrics,
    started: Instant,
    thread: Option<tokio::task::JoinHandle<anyhow::Result<Option<Vec<EpisodeOutcome>>>>>,
}

impl Running {
    /// Starts the episodes of a checked job.
    pub fn start(
        job: &Job,
        environments: Arc<dyn Environments>,
        policy: Arc<dyn Policy>,
        metrics: Metrics,
    ) -> Running {
        let shared = Arc::new(Shared::default());
        let thread = tokio::task::spawn_blocking({
            let (shared, metrics, job) = (shared.clone(), metrics.clone(), job.clone());
            // On a thread of rayon's pool: any other thread would have to wake one, and wait for
            // it, in each parallel part of each step.
            move || {
                let roll_out = |_: &_| {
                    roll_out(
                        environments.as_ref(),
                        &job,
                        policy.as_ref(),
                        &shared,
                        &metrics,
                        Job::LONGEST,
                    )
                };
                rayon::scope(roll_out)
            }
        });
        Running { shared, metrics, started: Instant::now(), thread: Some(thread) }
    }

    /// Episodes that have ended.
    pub fn episodes_done(&self) -> u32 {
        self.shared.episodes_done.load(Relaxed)
    }

    /// Environment steps so far.
    pub fn steps_done(&self) -> u64 {
        self.shared.steps_done.load(Relaxed)
    }

    /// Waits up to `patience` for the end; `None` if it has not come by then.
    pub async fn finished_within(
        &mut self,
        patience: Duration,
    ) -> Option<anyhow::Result<Vec<EpisodeScore>>> {
        let thread = self.thread.as_mut()?;
        let joined = tokio::time::timeout(patience, thread).await.ok()?;
        self.thread = None;
        Some(match joined {
            Ok(Ok(Some(outcomes))) => {
                self.metrics.job_duration.observe(self.started.elapsed().as_secs_f64());
                Ok(outcomes.iter().map(episode_score).collect())
            }
            Ok(Ok(None)) => Err(anyhow::anyhow!("it was canceled")),
            Ok(Err(error)) => Err(error),
            Err(error) => Err(error.into()),
        })
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if self.thread.is_some() {
            self.shared.canceled.store(true, Relaxed);
            self.metrics.job(JobOutcome::Abandoned);
        }
    }
}

/// Runs all episodes to their end; `None` if canceled. Fails if the policy cannot act, an
/// environment fails, or the job takes longer than `longest`.
fn roll_out(
    environments: &dyn Environments,
    job: &Job,
    policy: &dyn Policy,
    shared: &Shared,
    metrics: &Metrics,
    longest: Duration,
) -> anyhow::Result<Option<Vec<EpisodeOutcome>>> {
    let started = Instant::now();
    let mut rollout = episodes(environments, job, policy)?;
    while !rollout.is_done() {
        if shared.canceled.load(Relaxed) {
            return Ok(None);
        }
        if started.elapsed() > longest {
            metrics.rejected(JobError::TooLong.label());
            return Err(JobError::TooLong.into());
        }
        let steps = rollout.environment_steps();
        let times = [rollout.select_time(), rollout.physics_time()];
        let done = rollout.episodes_done();
        rollout.step(|observations, states, actions| {
            policy.act(observations, states, actions).context("the policy cannot act")
        })?;
        metrics.environment_steps.inc_by(rollout.environment_steps() - steps);
        metrics.select_seconds.inc_by((rollout.select_time() - times[0]).as_secs_f64());
        metrics.physics_seconds.inc_by((rollout.physics_time() - times[1]).as_secs_f64());
        let ended = rollout.episodes_done() - done;
        metrics.episodes.inc_by(ended as u64);
        shared.episodes_done.fetch_add(ended as u32, Relaxed);
        shared.steps_done.store(rollout.environment_steps(), Relaxed);
    }
    Ok(Some(rollout.into_outcomes()))
}

/// The episodes of the job, at their beginning.
fn episodes(
    environments: &dyn Environments,
    job: &Job,
    policy: &dyn Policy,
) -> Result<Rollout<EpisodeState>, EnvironmentError> {
    let make = || environments.make(&job.environment, job.environment_seed);
    Rollout::new(make, (policy.observation_dim(), policy.action_dim()), &job.seeds, |seed| {
        policy.begin(seed)
    })
}

fn episode_score(outcome: &EpisodeOutcome) -> EpisodeScore {
    let EpisodeOutcome { seed, episode_return, length, score, .. } = *outcome;
    EpisodeScore { seed, episode_return, length, score }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use quad_policy::{DiffusionShape, MlpConfig, Precision, load_policy};

    use super::super::fixtures::{self, file};
    use super::*;
    use crate::sim::{Environment, Simulations};

    fn job(episodes: u64) -> Job {
        Job { seeds: (0..episodes).collect(), ..fixtures::job() }
    }

    fn policy(hidden: usize, critics: usize, candidates: u32) -> Box<dyn Policy> {
        let shape = DiffusionShape::quad((11, 3), &MlpConfig::mish(&[hidden; 3]), critics, 1);
        load_policy(&file("hopper", shape, candidates), Precision::F32).unwrap()
    }

    #[test]
    fn a_job_that_is_empty_or_huge_is_refused() {
        let label = |episodes| check(&job(episodes), &Simulations).err().map(|error| error.label());
        assert_eq!([1, 256].map(label), [None; 2]);
        assert_eq!([0, 257, 65_536].map(label), [Some("job_size"); 3]);
    }

    #[test]
    fn a_job_has_a_longest_time() {
        let (job, policy, metrics) = (job(2), policy(8, 2, 1), Metrics::new().unwrap());
        let run = |longest| {
            roll_out(&Simulations, &job, policy.as_ref(), &Shared::default(), &metrics, longest)
        };
        assert_eq!(run(Job::LONGEST).unwrap().unwrap().len(), 2);
        let error = run(Duration::ZERO).unwrap_err();
        assert!(matches!(error.downcast_ref(), Some(JobError::TooLong)), "{error}");
    }

    /// Hopper under another name, which records the seeds of its environments.
    #[derive(Default)]
    struct Renamed(Mutex<Vec<u64>>);

    impl Environments for Renamed {
        fn names(&self) -> Vec<String> {
            vec!["my-robot".to_owned()]
        }

        fn sizes(&self, _: &str) -> Option<(usize, usize)> {
            None
        }

        fn make(
            &self,
            _: &str,
            environment_seed: u64,
        ) -> Result<Box<dyn Environment>, EnvironmentError> {
            self.0.lock().unwrap().push(environment_seed);
            Simulations.make("hopper", environment_seed)
        }
    }

    #[test]
    fn environments_are_made_by_the_job_s_name_and_seed() {
        let job = Job { environment: "my-robot".to_owned(), environment_seed: 5, ..job(2) };
        assert!(
            matches!(check(&job, &Simulations), Err(JobError::Environment(name)) if name == "my-robot")
        );
        let renamed = Renamed::default();
        check(&job, &renamed).unwrap();
        assert_eq!(
            check(&fixtures::job(), &renamed).map_err(|error| error.label()),
            Err("environment")
        );
        episodes(&renamed, &job, policy(1, 1, 1).as_ref()).unwrap();
        assert_eq!(renamed.0.into_inner().unwrap(), [5, 5]);
    }

    /// A file of some megabytes asks for 66 GB: a value of each of 65,535 tiny critics for each of
    /// 256,000 candidates.
    #[test]
    fn the_memory_of_a_policy_is_known_before_it_is_taken() {
        assert!(check_memory(&job(10), policy(256, 10, 50).as_ref()).is_ok(), "the paper's");
        assert!(check_memory(&job(1), policy(1, 65_535, 1).as_ref()).is_ok());
        let many_critics = check_memory(&job(256), policy(1, 65_535, 1000).as_ref());
        assert!(
            matches!(many_critics, Err(JobError::Memory(66_000_000_000..))),
            "{many_critics:?}"
        );
    }
}
