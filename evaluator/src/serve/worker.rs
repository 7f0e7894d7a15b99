//! The evaluator's main loop: serves the runs in turn, one job at a time.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_dataset::environment::EnvironmentSpec;
use quad_policy::{Policy, PolicyError, Precision};
use quad_protocol::{EpisodeScore, Hash, Job, Name, Progress, ScoreReport};
use quad_service::Beat;
use tokio::sync::{Notify, watch};
use tracing::{info, warn};

use super::discovery::{RunKey, Runs};
use super::job::{self, Running};
use super::receiver::policy_for;
use super::run::RunClient;
use crate::environment;
use crate::metrics::{JobOutcome, Metrics};

/// Progress is reported this often, or three times in a lease if that is more often.
const HEARTBEAT: Duration = Duration::from_secs(1);
/// Scores are kept this long for a learner that is gone, which may be disconnected only for a while.
const KEEP_SCORES: Duration = Duration::from_secs(600);

/// Serves every run that is found, one job at a time, in turn.
pub struct Worker {
    name: Name,
    precision: Precision,
    metrics: Metrics,
    found: watch::Receiver<Runs>,
    runs: BTreeMap<RunKey, RunClient>,
    /// The run that was served longest ago comes first.
    turns: VecDeque<RunKey>,
    /// Runs whose learner is gone but whose scores are kept, and since when.
    gone: BTreeMap<RunKey, Instant>,
    snapshot_arrived: Arc<Notify>,
    /// The policy of the last job: the next one is often about the same.
    policy: Option<(Hash, Arc<dyn Policy>)>,
    beat: Beat,
}

impl Worker {
    /// A worker for the runs that `found` names, which says by `beat` that it is not stuck.
    pub fn new(name: Name, precision: Precision, metrics: Metrics, found: watch::Receiver<Runs>, beat: Beat) -> Worker {
        Worker {
            name,
            precision,
            metrics,
            found,
            runs: BTreeMap::new(),
            turns: VecDeque::new(),
            gone: BTreeMap::new(),
            snapshot_arrived: Arc::new(Notify::new()),
            policy: None,
            beat,
        }
    }

    /// Serves until it is dropped. Dropped in the middle of a job, it abandons the job.
    pub async fn run(mut self) -> anyhow::Error {
        loop {
            self.beat.alive();
            self.follow_discovery().await;
            let now = Instant::now();
            let due =
                |key: &&RunKey| self.is_there(key) && self.runs.get(*key).is_some_and(|run| run.ready_at() <= now);
            match self.turns.iter().find(due).cloned() {
                Some(key) => self.turn(key).await,
                None => {
                    if let Err(error) = self.wait().await {
                        return error;
                    }
                }
            }
        }
    }

    fn is_there(&self, key: &RunKey) -> bool {
        !self.gone.contains_key(key)
    }

    /// Attaches to runs that appeared, detaches from runs that are gone.
    async fn follow_discovery(&mut self) {
        let found = self.found.borrow_and_update().clone();
        for (key, session) in &found {
            if self.gone.remove(key).is_some()
                && let Some(run) = self.runs.get_mut(key)
            {
                run.wake();
            }
            if self.runs.contains_key(key) {
                continue;
            }
            let (metrics, arrived) = (self.metrics.clone(), self.snapshot_arrived.clone());
            match RunClient::attach(session.clone(), key.1.clone(), self.name.clone(), metrics, arrived).await {
                Ok(run) => {
                    self.runs.insert(key.clone(), run);
                    self.turns.push_front(key.clone());
                }
                Err(error) => warn!("{error:#}"),
            }
        }
        let now = Instant::now();
        let absent: Vec<RunKey> = self.runs.keys().filter(|key| !found.contains_key(key)).cloned().collect();
        for key in absent {
            let since = *self.gone.entry(key.clone()).or_insert(now);
            let kept = self.runs.get(&key).is_some_and(RunClient::has_undelivered) && now - since < KEEP_SCORES;
            if !kept {
                self.gone.remove(&key);
                self.turns.retain(|other| *other != key);
                if let Some(run) = self.runs.remove(&key) {
                    run.give_up();
                }
            }
        }
        self.metrics.runs.set(self.runs.len() as i64);
    }

    /// Waits until a run is due, runs come or go, or a new snapshot promises work.
    async fn wait(&mut self) -> anyhow::Result<()> {
        let there = self.runs.iter().filter(|(key, _)| self.is_there(key)).map(|(_, run)| run.ready_at());
        let forget = self.gone.values().map(|since| *since + KEEP_SCORES);
        let until = there.chain(forget).min();
        let timer = async {
            match until {
                Some(until) => tokio::time::sleep_until(until.into()).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = timer => {}
            () = tokio::time::sleep(self.beat.interval()) => {}
            changed = self.found.changed() => changed.context("nobody looks for learners any more")?,
            () = self.snapshot_arrived.notified() => self.runs.values_mut().for_each(RunClient::wake),
        }
        Ok(())
    }

    /// One run's turn: delivers scores if there are any, else does one job.
    async fn turn(&mut self, key: RunKey) {
        self.turns.retain(|other| *other != key);
        self.turns.push_back(key.clone());
        let Some(mut run) = self.runs.remove(&key) else { return };
        if let Err(error) = self.serve(&key.1, &mut run).await {
            warn!(run = %key.1, "{error:#}");
            run.back_off();
        }
        self.runs.insert(key, run);
    }

    async fn serve(&mut self, name: &Name, run: &mut RunClient) -> anyhow::Result<()> {
        if run.has_undelivered() {
            return run.deliver().await;
        }
        let environments = environment::simulated().map(|spec| spec.name.clone()).collect();
        let Some(job) = run.claim(environments).await? else { return Ok(()) };
        let (episodes, cannot_act) = match self.measure(name, &job, run).await {
            Ok(episodes) => (episodes, None),
            Err(error) => {
                self.metrics.job(JobOutcome::Failed);
                let broken = matches!(error.downcast_ref(), Some(PolicyError::NotANumber(_)));
                let error = error.context(format!("job {} of step {} failed", job.id, job.step));
                if !broken {
                    return Err(error);
                }
                // The learner must know, or it would hand the job out again and again.
                warn!(run = %name, "{error:#}");
                (Vec::new(), Some(format!("{:#}", error.root_cause())))
            }
        };
        let Job { id, run: of, incarnation, step, weights, .. } = job;
        let (evaluator, precision) = (self.name.clone(), Name::new(self.precision.in_effect().name())?);
        run.keep(ScoreReport {
            evaluator,
            run: of,
            incarnation,
            job: id,
            step,
            weights,
            precision,
            episodes,
            cannot_act,
        });
        run.deliver().await
    }

    async fn measure(&mut self, name: &Name, job: &Job, run: &RunClient) -> anyhow::Result<Vec<EpisodeScore>> {
        let spec = job::check(job, name).inspect_err(|error| self.metrics.rejected(error.label()))?;
        let policy = self.policy(job, run).await?;
        info!(run = %name, step = job.step, episodes = job.seeds.len(), "evaluating");
        self.roll_out(job, spec, policy, run).await
    }

    /// The policy that `job` names, from the last job or from a snapshot.
    async fn policy(&mut self, job: &Job, run: &RunClient) -> anyhow::Result<Arc<dyn Policy>> {
        if let Some((_, policy)) = self.policy.as_ref().filter(|(weights, _)| *weights == job.weights) {
            return Ok(policy.clone());
        }
        // Freed before the next one is built: an evaluator holds one policy.
        self.policy = None;
        let snapshot = run.snapshot(job).await?;
        let built = tokio::task::spawn_blocking({
            let (job, precision) = (job.clone(), self.precision);
            move || policy_for(&job, &snapshot, precision)
        });
        let policy = built.await?.inspect_err(|error| self.metrics.rejected(error.label()))?;
        Ok(self.policy.insert((job.weights, Arc::from(policy))).1.clone())
    }

    /// Runs the episodes, and reports progress to the learner as long as there is any: a stuck simulation loses its lease.
    async fn roll_out(
        &self,
        job: &Job,
        spec: &'static EnvironmentSpec,
        policy: Arc<dyn Policy>,
        run: &RunClient,
    ) -> anyhow::Result<Vec<EpisodeScore>> {
        let heartbeat = HEARTBEAT.min(Duration::from_millis(job.lease_milliseconds / 3)).max(HEARTBEAT / 20);
        let mut running = Running::start(job, spec, policy, self.metrics.clone());
        let mut told = self.metrics.environment_steps.get();
        loop {
            let finished = running.finished_within(heartbeat).await;
            let steps = self.metrics.environment_steps.get();
            if steps > told {
                told = steps;
                self.beat.alive();
                run.publish(&Progress {
                    evaluator: self.name.clone(),
                    run: job.run.clone(),
                    job: job.id,
                    step: job.step,
                    episodes_done: running.episodes_done(),
                    episodes_total: job.seeds.len() as u32,
                    environment_steps: steps,
                    episodes: self.metrics.episodes.get(),
                })
                .await;
            }
            if let Some(episodes) = finished {
                return episodes;
            }
        }
    }
}

#[cfg(test)]
mod tests;
