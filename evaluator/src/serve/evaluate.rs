//! Runs jobs, one at a time: loads the policy, plays the episodes, reports progress.

use std::sync::Arc;
use std::time::Duration;

use quad_policy::{Header, Policy, Precision, load_policy};
use quad_protocol::{Hash, Job, Name, Origin, Snapshot};
use quad_runtime::Heartbeat;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};
use tracing::info;

use super::connection::Connection;
use super::delivery::Owed;
use super::job::{self, Done, JobError, Played};
use crate::metrics::Metrics;
use crate::sim::Environments;

/// Limits of the interval between reports of progress, which a learner chooses.
const HEARTBEAT: [Duration; 2] = [Duration::from_millis(50), Duration::from_secs(20)];

/// Most characters of an environment's name from a file in a message.
const MAX_NAME_LEN: usize = 64;

pub struct Evaluator {
    pub name: Name,
    pub environments: Arc<dyn Environments>,
    pub precision: Precision,
    pub metrics: Metrics,
    /// The policy of the last job, with the hash of its weights and its environment, which the next
    /// job often needs again.
    pub policy: Option<(Hash, String, Arc<dyn Policy>)>,
    pub beat: Heartbeat,
}

impl Evaluator {
    /// Runs all episodes of `job`, which the learner at `connection` has given out. Awaits its
    /// `snapshot` if another policy was loaded last.
    pub async fn evaluate(
        &mut self,
        job: &Job,
        connection: &Connection,
        snapshot: impl Future<Output = anyhow::Result<Arc<Snapshot>>>,
    ) -> anyhow::Result<Owed> {
        let metrics = self.metrics.clone();
        let reject = |error: &JobError| metrics.rejected(error.label());
        job::check(job, &*self.environments).inspect_err(reject)?;
        // The learner grants time to load the policy as long as there are reports.
        connection.publish_progress(job, 0, 0);
        let policy = {
            let mut loading = std::pin::pin!(self.policy(job, snapshot));
            loop {
                tokio::select! {
                    policy = &mut loading => break policy?,
                    () = sleep(heartbeat(job)) => connection.publish_progress(job, 0, 0),
                }
            }
        };
        job::check_memory(job, &*policy).inspect_err(reject)?;
        let arithmetic = Name::new(policy.precision().arithmetic())?;
        let doing = if job.exploration.is_some() { "playing" } else { "evaluating" };
        info!(run = %job.run, step = job.step, episodes = job.seeds.len(), "{doing}");
        let report = |done: Done| connection.publish_progress(job, done.steps, done.episodes);
        let played = self.roll_out(job, policy, report).await?;
        Ok(Owed::new(job, self.name.clone(), arithmetic, played)?)
    }

    /// The policy of `job`, kept from the last job or loaded from a snapshot.
    async fn policy(
        &mut self,
        job: &Job,
        snapshot: impl Future<Output = anyhow::Result<Arc<Snapshot>>>,
    ) -> anyhow::Result<Arc<dyn Policy>> {
        let name = job.environment.clone();
        if let Some((weights, environment, policy)) = &self.policy
            && (*weights, environment) == (job.weights, &name)
        {
            return Ok(policy.clone());
        }
        // Freed before the next policy is built: an evaluator holds one policy.
        self.policy = None;
        let (snapshot, precision) = (snapshot.await?, self.precision);
        let (wanted, sizes) = (name.clone(), self.environments.sizes(&name));
        let load = move || load(&snapshot, (&wanted, sizes), precision);
        let policy: Arc<dyn Policy> = tokio::task::spawn_blocking(load)
            .await?
            .inspect_err(|error| self.metrics.rejected(error.label()))?
            .into();
        self.policy = Some((job.weights, name, policy.clone()));
        Ok(policy)
    }

    /// Runs the episodes, and reports progress as long as there is any: the learner gives the job
    /// of a stuck simulation to another evaluator.
    async fn roll_out(
        &self,
        job: &Job,
        policy: Arc<dyn Policy>,
        report: impl Fn(Done),
    ) -> anyhow::Result<Played> {
        let (tx, rx) = watch::channel(Done::default());
        let (environments, metrics) = (self.environments.clone(), self.metrics.clone());
        let mut episodes = job::start(job.clone(), environments, policy, metrics, tx);
        let mut reported = 0;
        loop {
            if let Ok(ended) = timeout(heartbeat(job), &mut episodes).await {
                return ended?;
            }
            let done = *rx.borrow();
            if done.steps > reported {
                self.beat.alive();
            }
            // The first step of a large policy takes long.
            if done.steps > reported || done.steps == 0 {
                reported = done.steps;
                report(done);
            }
        }
    }
}

fn heartbeat(job: &Job) -> Duration {
    Duration::from_millis(job.progress_milliseconds).clamp(HEARTBEAT[0], HEARTBEAT[1])
}

/// Loads the policy of `snapshot` for the environment `wanted`, whose sizes may be known.
fn load(
    snapshot: &Snapshot,
    (wanted, wanted_sizes): (&str, Option<(usize, usize)>),
    precision: Precision,
) -> Result<Box<dyn Policy>, JobError> {
    let Header { origin: Origin { environment, .. }, .. } = Header::read(&snapshot.file)?;
    let policy = load_policy(&snapshot.file, precision)?;
    let sizes = (policy.observation_dim(), policy.action_dim());
    let wanted_sizes = wanted_sizes.unwrap_or(sizes);
    if (environment.as_str(), sizes) == (wanted, wanted_sizes) {
        return Ok(policy);
    }
    let [snapshot, job] = [(&*environment, sizes), (wanted, wanted_sizes)].map(describe);
    Err(JobError::OtherEnvironment { snapshot, job })
}

fn describe((name, (observation_dim, action_dim)): (&str, (usize, usize))) -> String {
    let name: String = name.chars().take(MAX_NAME_LEN).collect();
    format!("{name} ({observation_dim} numbers observed, {action_dim} in an action)")
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::time::Instant;

    use quad_policy::{EpisodeState, PolicyError};
    use quad_runtime::Health;

    use super::super::fixtures::{evaluator, file, job, smallest, snapshot};
    use super::*;

    const LIMIT: Duration = Duration::from_secs(1);
    const STUCK_AT: usize = 3;

    /// Acts slowly, and keeps the evaluator's health at each call. One call lasts until that is stuck.
    #[derive(Default)]
    struct Sleeper {
        health: Health,
        seen: Mutex<Vec<bool>>,
    }

    impl Policy for Sleeper {
        fn observation_dim(&self) -> usize {
            11
        }

        fn action_dim(&self) -> usize {
            3
        }

        fn precision(&self) -> Precision {
            Precision::F32
        }

        fn memory(&self, _: usize) -> u64 {
            0
        }

        fn act(
            &self,
            _: &[f32],
            _: &mut [EpisodeState],
            actions: &mut [f32],
        ) -> Result<(), PolicyError> {
            let is_well = || self.health.problems().is_empty();
            let mut seen = self.seen.lock().unwrap();
            let until = Instant::now() + Duration::from_secs(60);
            while seen.len() == STUCK_AT && is_well() && Instant::now() < until {
                std::thread::sleep(LIMIT / 50);
            }
            std::thread::sleep(LIMIT / 50);
            seen.push(is_well());
            actions.fill(0.0);
            Ok(())
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn is_healthy_as_long_as_a_job_advances() {
        let policy = Arc::new(Sleeper::default());
        let evaluator = evaluator(&policy.health, LIMIT);
        let job = job();
        let episodes = evaluator.roll_out(&job, policy.clone(), |_| ());
        assert_eq!(episodes.await.unwrap().len(), job.seeds.len());
        let seen = policy.seen.lock().unwrap();
        assert!(!seen[STUCK_AT] && seen[STUCK_AT + 1..].contains(&true), "{seen:?}");
    }

    #[test]
    fn loads_a_snapshot_only_for_its_own_environment() {
        let label = |file| {
            let loaded = load(&snapshot(file), ("hopper", Some((11, 3))), Precision::F32);
            loaded.err().map(|error| error.label())
        };
        let (mut observes_more, mut acts_more) = (smallest(), smallest());
        (observes_more.observation_dim, acts_more.action_dim) = (17, 6);
        let hopper = file("hopper", smallest(), 1);
        assert_eq!(label(hopper.clone()), None);
        for other in [
            file("walker2d", smallest(), 1),
            file(&"h".repeat(500_000), smallest(), 1),
            file("hopper", observes_more, 1),
            file("hopper", acts_more, 1),
        ] {
            assert_eq!(label(other), Some("environment"));
        }
        assert_eq!(label(hopper[..100].to_vec()), Some("tensors"));
    }
}
