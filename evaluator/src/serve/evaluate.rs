//! Evaluates jobs, one at a time: loads the policy of a job, runs its episodes, reports progress to
//! the learner.

use std::sync::Arc;
use std::time::Duration;

use quad_policy::{Policy, Precision};
use quad_protocol::{EpisodeScore, Hash, Job, Name, ScoreReport};
use quad_runtime::Heartbeat;
use tracing::info;

use super::client::RunClient;
use super::job::{self, Running};
use super::policy::load;
use crate::metrics::Metrics;
use crate::sim::Environments;

/// Limits of the time between two reports of progress, which a learner chooses.
const HEARTBEAT: [Duration; 2] = [Duration::from_millis(50), Duration::from_secs(20)];

/// Evaluates jobs.
pub struct Evaluator {
    /// The evaluator's name in every run.
    pub name: Name,
    /// The environments in which it can act.
    pub environments: Arc<dyn Environments>,
    precision: Precision,
    metrics: Metrics,
    /// The policy of the last job, with its weights and its environment, which the next job often
    /// needs again.
    policy: Option<(Hash, String, Arc<dyn Policy>)>,
    /// Reports that the evaluator is not stuck.
    pub beat: Heartbeat,
}

impl Evaluator {
    /// An evaluator that computes policies in `precision`, if the CPU supports it.
    pub fn new(
        name: Name,
        environments: Arc<dyn Environments>,
        precision: Precision,
        metrics: Metrics,
        beat: Heartbeat,
    ) -> Evaluator {
        Evaluator { name, environments, precision, metrics, policy: None, beat }
    }

    /// Runs all episodes of `job`, which the learner of `client` has given out, with one snapshot.
    pub async fn evaluate(&mut self, job: &Job, client: &RunClient) -> anyhow::Result<ScoreReport> {
        let metrics = self.metrics.clone();
        job::check(job, self.environments.as_ref())
            .inspect_err(|error| metrics.rejected(error.label()))?;
        let policy = {
            // The learner grants time for this, as long as the evaluator reports that it works on
            // it.
            client.tell(job, 0, 0);
            let mut loading = std::pin::pin!(self.policy(job, client));
            loop {
                tokio::select! {
                    policy = &mut loading => break policy?,
                    () = tokio::time::sleep(heartbeat(job)) => client.tell(job, 0, 0),
                }
            }
        };
        job::check_memory(job, policy.as_ref())
            .inspect_err(|error| metrics.rejected(error.label()))?;
        let arithmetic = Name::new(policy.precision().arithmetic())?;
        info!(run = %job.run, step = job.step, episodes = job.seeds.len(), "evaluating");
        let episodes =
            self.roll_out(job, policy, |steps, episodes| client.tell(job, steps, episodes)).await?;
        Ok(ScoreReport::of(job, self.name.clone(), arithmetic, episodes))
    }

    /// The policy of `job`, kept from the last job or loaded from a snapshot.
    async fn policy(&mut self, job: &Job, client: &RunClient) -> anyhow::Result<Arc<dyn Policy>> {
        let name = &job.environment;
        if let Some((.., policy)) =
            self.policy.as_ref().filter(|last| (last.0, &last.1) == (job.weights, name))
        {
            return Ok(policy.clone());
        }
        // Freed before the next policy is built: an evaluator holds one policy.
        self.policy = None;
        let (snapshot, precision) = (client.snapshot(job).await?, self.precision);
        let (wanted, sizes) = (name.clone(), self.environments.sizes(name));
        let loaded =
            tokio::task::spawn_blocking(move || load(&snapshot, (&wanted, sizes), precision))
                .await?;
        let policy: Arc<dyn Policy> =
            loaded.inspect_err(|error| self.metrics.rejected(error.label()))?.into();
        self.policy = Some((job.weights, name.clone(), policy.clone()));
        Ok(policy)
    }

    /// Runs the episodes, and reports progress as long as there is any: the learner gives the job
    /// of a stuck simulation to another evaluator.
    async fn roll_out(
        &self,
        job: &Job,
        policy: Arc<dyn Policy>,
        tell: impl Fn(u64, u32),
    ) -> anyhow::Result<Vec<EpisodeScore>> {
        let mut running =
            Running::start(job, self.environments.clone(), policy, self.metrics.clone());
        let mut told = 0;
        loop {
            if let Some(episodes) = running.finished_within(heartbeat(job)).await {
                return episodes;
            }
            let steps = running.steps_done();
            if steps > told {
                self.beat.alive();
            }
            // The evaluator also reports that no step is done yet: the first step of a large policy
            // takes long.
            if steps > told || steps == 0 {
                told = steps;
                tell(steps, running.episodes_done());
            }
        }
    }
}

fn heartbeat(job: &Job) -> Duration {
    Duration::from_millis(job.progress_milliseconds).clamp(HEARTBEAT[0], HEARTBEAT[1])
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
    use std::time::Instant;

    use quad_policy::{EpisodeState, PolicyError};
    use quad_runtime::Health;

    use super::super::fixtures::job;
    use super::*;
    use crate::sim::Simulations;

    const LIMIT: Duration = Duration::from_secs(1);
    const STUCK_AT: u32 = 3;

    /// Acts slowly; one call lasts until that is noticed.
    struct Sleeper {
        calls: AtomicU32,
        health: Health,
        noticed: AtomicBool,
        /// Whether the job was well afterwards.
        recovered: AtomicBool,
    }

    impl Sleeper {
        fn is_well(&self) -> bool {
            self.health.problems().is_empty()
        }
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
            let call = self.calls.fetch_add(1, Relaxed);
            let until = Instant::now() + Duration::from_secs(60);
            while call == STUCK_AT && self.is_well() && Instant::now() < until {
                std::thread::sleep(LIMIT / 50);
            }
            self.noticed.fetch_or(call == STUCK_AT && !self.is_well(), Relaxed);
            std::thread::sleep(LIMIT / 50);
            self.recovered.fetch_or(call > STUCK_AT && self.is_well(), Relaxed);
            actions.fill(0.0);
            Ok(())
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_job_is_well_as_long_as_it_advances() {
        let health = Health::default();
        let (name, metrics) = (Name::new("evaluator").unwrap(), Metrics::new().unwrap());
        let beat = health.register("worker", LIMIT);
        let evaluator = Evaluator::new(name, Arc::new(Simulations), Precision::F32, metrics, beat);
        let [noticed, recovered] = [false; 2].map(AtomicBool::new);
        let policy = Arc::new(Sleeper { calls: AtomicU32::new(0), health, noticed, recovered });
        assert_eq!(evaluator.roll_out(&job(), policy.clone(), |_, _| ()).await.unwrap().len(), 2);
        assert!(policy.noticed.load(Relaxed), "it was stuck");
        assert!(policy.recovered.load(Relaxed), "it has advanced since");
    }
}
