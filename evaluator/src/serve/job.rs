//! One job: all of its episodes as one batch, on its own thread.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_policy::{Policy, PolicyError};
use quad_protocol::{Episode, EpisodeScore, Job, Name};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use super::exploration::explore;
use crate::metrics::Metrics;
use crate::sim::{Environments, Rollout};

/// Most episodes of a job: each is a simulation. A learner gives forty at most.
const MAX_EPISODES: usize = 256;
/// Most bytes of one network call: far more than the paper's few megabytes, far less than an
/// evaluator's container has (1 GiB in docker-compose.yml) beside snapshots and the policy.
const MAX_BYTES: u64 = 256 << 20;

/// Reason not to run a job.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    #[error("it has {0} episodes, but must have from 1 to {MAX_EPISODES}, or one online episode")]
    Size(usize),
    #[error("each of its steps takes {0} bytes of memory, more than {MAX_BYTES}")]
    Memory(u64),
    #[error("its episodes did not end within {} s", Job::LONGEST.as_secs())]
    TooLong,
    #[error("this evaluator has no environment \"{0}\"")]
    Environment(String),
    #[error("the snapshot is for {snapshot}, the job's environment is {job}")]
    OtherEnvironment { snapshot: String, job: String },
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

/// Checks the episodes and the environment of a learner's job.
pub fn check(job: &Job, environments: &dyn Environments) -> Result<(), JobError> {
    let episodes = job.seeds.len();
    let most = job.exploration.map_or(MAX_EPISODES, |_| 1);
    if !(1..=most).contains(&episodes) {
        return Err(JobError::Size(episodes));
    }
    match environments.names().contains(&job.environment) {
        true => Ok(()),
        false => Err(JobError::Environment(job.environment.clone())),
    }
}

pub fn check_memory(job: &Job, policy: &dyn Policy) -> Result<(), JobError> {
    let bytes = policy.memory(job.seeds.len());
    match bytes > MAX_BYTES {
        true => Err(JobError::Memory(bytes)),
        false => Ok(()),
    }
}

/// The episodes of a job; those that are online with their experience.
pub type Played = Vec<(EpisodeScore, Option<Episode>)>;

/// Environment steps taken and episodes ended.
#[derive(Clone, Copy, Default)]
pub struct Done {
    pub steps: u64,
    pub episodes: u32,
}

/// Starts the episodes of a checked job. They stop within one step, and the job counts as
/// abandoned, if all receivers of `tx` are dropped.
pub fn start(
    job: Job,
    environments: Arc<dyn Environments>,
    policy: Arc<dyn Policy>,
    metrics: Metrics,
    tx: watch::Sender<Done>,
) -> JoinHandle<anyhow::Result<Played>> {
    tokio::task::spawn_blocking(move || {
        let longest = Job::LONGEST;
        // On a thread of rayon's pool: any other thread would have to wake one, and wait for it, in
        // each parallel part of each step.
        rayon::scope(|_| run(&*environments, &job, &*policy, &metrics, &tx, longest))
    })
}

/// Runs all episodes. Fails if the policy cannot act, an environment fails, the job is canceled or
/// takes longer than `longest`.
fn run(
    environments: &dyn Environments,
    job: &Job,
    policy: &dyn Policy,
    metrics: &Metrics,
    tx: &watch::Sender<Done>,
    longest: Duration,
) -> anyhow::Result<Played> {
    let started = Instant::now();
    let make = || {
        let mut made = environments.make(&job.environment, job.environment_seed);
        if let (Ok(environment), Some(_)) = (&mut made, job.exploration) {
            environment.allow_interventions();
        }
        made
    };
    let sizes = (policy.observation_dim(), policy.action_dim());
    let mut rollout = Rollout::new(make, sizes, &job.seeds, |seed| policy.begin(seed))?;
    if job.exploration.is_some() {
        let precision = Name::new(policy.precision().arithmetic())?;
        rollout = rollout.recording(job.step, job.weights, &precision);
    }
    while !rollout.is_done() {
        if tx.is_closed() {
            metrics.job("abandoned");
            anyhow::bail!("it was canceled");
        }
        if started.elapsed() > longest {
            metrics.rejected(JobError::TooLong.label());
            return Err(JobError::TooLong.into());
        }
        let stepped = rollout.step(|observations, states, actions| {
            let acted = match job.exploration {
                None => policy.act(observations, states, actions),
                Some(rule) => explore(rule, policy, observations, states, actions),
            };
            acted.context("the policy cannot act")
        })?;
        let seconds = [stepped.select, stepped.physics].map(|time| time.as_secs_f64());
        metrics.environment_steps.inc_by(stepped.steps);
        metrics.episodes.inc_by(stepped.ended.into());
        metrics.select_seconds.inc_by(seconds[0]);
        metrics.physics_seconds.inc_by(seconds[1]);
        tx.send_modify(|done| {
            done.steps += stepped.steps;
            done.episodes += stepped.ended;
        });
    }
    let duration = started.elapsed().as_secs_f64();
    metrics.job_duration.observe(duration);
    Ok(rollout.into_records())
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

    use quad_policy::{DiffusionShape, MlpConfig, Precision, load_policy};
    use quad_protocol::Exploration;

    use super::super::fixtures::{self, file};
    use super::*;
    use crate::sim::{Environment, EnvironmentError, Simulations, Step};

    fn job(episodes: u64) -> Job {
        let mut job = fixtures::job();
        job.seeds = (0..episodes).collect();
        job
    }

    fn policy(hidden: usize, critics: usize, candidates: u32) -> Box<dyn Policy> {
        let shape = DiffusionShape::quad((11, 3), &MlpConfig::mish(&[hidden; 3]), critics, 1);
        load_policy(&file("hopper", shape, candidates), Precision::F32).unwrap()
    }

    /// Runs a job for at most `longest`.
    fn run_for(
        environments: &dyn Environments,
        job: &Job,
        longest: Duration,
    ) -> anyhow::Result<Played> {
        let (tx, _rx) = watch::channel(Done::default());
        let (policy, metrics) = (policy(8, 2, 1), Metrics::new().unwrap());
        run(environments, job, &*policy, &metrics, &tx, longest)
    }

    /// Records the seeds of its environments, and counts the episodes in which a person may act.
    #[derive(Default)]
    struct Watched {
        seeds: Mutex<Vec<u64>>,
        allowed: Arc<AtomicU32>,
    }

    impl Environments for Watched {
        fn names(&self) -> Vec<String> {
            vec!["my-robot".to_owned()]
        }

        fn sizes(&self, _: &str) -> Option<(usize, usize)> {
            None
        }

        fn make(&self, _: &str, seed: u64) -> Result<Box<dyn Environment>, EnvironmentError> {
            self.seeds.lock().unwrap().push(seed);
            Ok(Box::new(OneStep(self.allowed.clone())))
        }
    }

    struct OneStep(Arc<AtomicU32>);

    impl Environment for OneStep {
        fn name(&self) -> &str {
            "my-robot"
        }

        fn allow_interventions(&mut self) {
            self.0.fetch_add(1, Relaxed);
        }

        fn reset(&mut self, _: u64) -> Result<(), EnvironmentError> {
            Ok(())
        }

        fn step(&mut self, _: &[f32]) -> Result<Step, EnvironmentError> {
            Ok(Step { truncated: true, ..Step::default() })
        }

        fn observation(&self) -> &[f64] {
            &[0.0; 11]
        }

        fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
            Ok(episode_return)
        }
    }

    #[test]
    fn refuses_empty_and_huge_jobs_and_unknown_environments() {
        let check = |episodes| check(&job(episodes), &Simulations);
        for episodes in [1, 256] {
            check(episodes).unwrap();
        }
        for episodes in [0, 257, 65_536] {
            assert_eq!(check(episodes).unwrap_err().label(), "job_size");
        }
        let unknown = super::check(&job(1), &Watched::default());
        assert_eq!(unknown.unwrap_err().label(), "environment");
    }

    #[test]
    fn makes_environments_by_the_job_s_seed_tells_them_of_online_episodes_and_limits_its_time() {
        let watched = Watched::default();
        let mut job = job(2);
        (job.environment, job.environment_seed) = ("my-robot".to_owned(), 5);
        check(&job, &watched).unwrap();
        assert_eq!(run_for(&watched, &job, Job::LONGEST).unwrap().len(), 2);
        assert_eq!(
            (&**watched.seeds.lock().unwrap(), watched.allowed.load(Relaxed)),
            (&[5, 5][..], 0)
        );
        let error = run_for(&watched, &job, Duration::ZERO).unwrap_err();
        assert_eq!(error.to_string(), JobError::TooLong.to_string());
        (job.seeds, job.exploration) = (vec![1], Some(Exploration::Uniform));
        run_for(&watched, &job, Job::LONGEST).unwrap();
        assert_eq!(watched.allowed.load(Relaxed), 1);
    }

    /// A file of some megabytes asks for 66 GB: one value from each of 65,535 tiny critics for each
    /// of 256,000 candidates.
    #[test]
    fn knows_the_memory_of_a_policy_before_taking_it() {
        check_memory(&job(10), &*policy(256, 10, 50)).unwrap(); // The paper's.
        check_memory(&job(1), &*policy(1, 65_535, 1)).unwrap();
        let huge = check_memory(&job(256), &*policy(1, 65_535, 1000));
        let is_refused = matches!(huge, Err(JobError::Memory(66_000_000_000..)));
        assert!(is_refused, "{huge:?}");
    }
}
