//! The evaluator's main loop: serves the runs in turn, one job at a time.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_dataset::environment::EnvironmentSpec;
use quad_policy::{Policy, Precision};
use quad_protocol::{EpisodeScore, Hash, Job, Name, ScoreReport};
use quad_service::Beat;
use tokio::sync::{Notify, watch};
use tracing::{info, warn};

use super::budget::Budget;
use super::discovery::{RunKey, Runs};
use super::hand_back::HandBack;
use super::job::{self, Running};
use super::loading::policy_for;
use super::run::{Identity, RunClient};
use super::turns::Turns;
use crate::environment;
use crate::metrics::{JobOutcome, Metrics};

/// Bounds of the time between two reports of progress that a learner may ask for.
const HEARTBEAT: [Duration; 2] = [Duration::from_millis(50), Duration::from_secs(20)];
/// Scores are kept this long for a learner that is gone, which may be disconnected only for a while.
const KEEP_SCORES: Duration = Duration::from_secs(600);
/// Memory for the snapshots that were published, of all runs together, bytes; the largest that there may be fits.
const SNAPSHOTS: usize = 256 << 20;
/// How long it may take to hand back a job that could not be done; other runs wait meanwhile.
const HAND_BACK: Duration = Duration::from_secs(2);

/// The jobs that are being done, or whose scores were not acknowledged, for whoever has to end them when the worker is to end.
pub type Held = Arc<Mutex<BTreeMap<RunKey, HandBack>>>;

/// Serves every run that is found, one job at a time.
pub struct Worker {
    identity: Identity,
    precision: Precision,
    metrics: Metrics,
    found: watch::Receiver<Runs>,
    runs: BTreeMap<RunKey, RunClient>,
    turns: Turns,
    /// Runs whose learner is gone but whose scores are kept, and since when.
    gone: BTreeMap<RunKey, Instant>,
    snapshot_arrived: Arc<Notify>,
    budget: Budget,
    held: Held,
    /// The policy of the last job: the next one is often about the same.
    policy: Option<(Hash, Arc<dyn Policy>)>,
    beat: Beat,
}

impl Worker {
    /// A worker for the runs that `found` names, which says by `beat` that it is not stuck.
    ///
    /// # Errors
    ///
    /// The arithmetic has no name that may cross the wire, which none of ours has not.
    pub fn new(
        evaluator: Name,
        precision: Precision,
        metrics: Metrics,
        found: watch::Receiver<Runs>,
        beat: Beat,
    ) -> anyhow::Result<Worker> {
        let identity = Identity { evaluator, precision: Name::new(precision.arithmetic())? };
        Ok(Worker {
            identity,
            precision,
            metrics,
            found,
            runs: BTreeMap::new(),
            turns: Turns::new(Instant::now()),
            gone: BTreeMap::new(),
            snapshot_arrived: Arc::new(Notify::new()),
            budget: Budget::new(SNAPSHOTS),
            held: Held::default(),
            policy: None,
            beat,
        })
    }

    /// Where the jobs are that it has not ended.
    pub fn held(&self) -> Held {
        self.held.clone()
    }

    /// Serves until it is dropped. Dropped in the middle of a job, it abandons the job.
    pub async fn run(mut self) -> anyhow::Error {
        loop {
            self.beat.alive();
            self.follow_discovery().await;
            let there = self.runs.iter().filter(|(key, _)| self.is_there(key)).map(|(key, run)| (key, &run.standing));
            match self.turns.next(there, Instant::now()).cloned() {
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
        for (key, learner) in &found {
            let was_gone = self.gone.remove(key).is_some();
            if let Some(run) = self.runs.get_mut(key) {
                run.follow(learner);
                if was_gone {
                    run.standing.wake(Instant::now());
                }
                continue;
            }
            let (identity, metrics) = (self.identity.clone(), self.metrics.clone());
            let memory = (self.snapshot_arrived.clone(), self.budget.clone());
            match RunClient::attach(key.1.clone(), learner, identity, metrics, memory).await {
                Ok(mut run) => {
                    run.standing
                        .start_from(self.runs.values().map(|run| run.standing.used()).min().unwrap_or_default());
                    self.runs.insert(key.clone(), run);
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
                self.hold(&key, None);
                if let Some(run) = self.runs.remove(&key) {
                    run.give_up();
                }
            }
        }
        self.metrics.runs.set(self.runs.len() as i64);
    }

    /// Waits until a run is due, runs come or go, or a new snapshot promises work.
    async fn wait(&mut self) -> anyhow::Result<()> {
        let there = self.runs.iter().filter(|(key, _)| self.is_there(key)).map(|(_, run)| run.standing.ready_at());
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
            () = self.snapshot_arrived.notified() => self.runs.values_mut().for_each(RunClient::wake_for_snapshot),
        }
        Ok(())
    }

    /// One run's turn: delivers scores if there are any, else does one job.
    async fn turn(&mut self, key: RunKey) {
        let Some(mut run) = self.runs.remove(&key) else { return };
        let started = Instant::now();
        if let Err(error) = self.serve(&key, &mut run).await {
            run.back_off(&error);
            if let Some(learner) = self.found.borrow().get(&key) {
                run.follow_next(&learner.lives);
            }
        }
        self.turns.over(&mut run.standing, started, Instant::now());
        self.runs.insert(key, run);
    }

    async fn serve(&mut self, key: &RunKey, run: &mut RunClient) -> anyhow::Result<()> {
        if run.has_undelivered() {
            return self.deliver(key, run).await;
        }
        let name = &key.1;
        let environments = environment::simulated().map(|spec| spec.name.clone()).collect();
        let Some(job) = run.claim(environments).await? else { return Ok(()) };
        self.hold(key, Some(run.hand_back(&job)));
        let episodes = match self.measure(name, &job, run).await {
            Ok(episodes) => episodes,
            Err(error) => {
                self.metrics.job(JobOutcome::Failed);
                self.hold(key, None);
                run.hand_back(&job).because(&format!("{error:#}")).send(HAND_BACK).await;
                return Err(error.context(format!("a job of step {} failed", job.step)));
            }
        };
        let Identity { evaluator, precision } = self.identity.clone();
        let report = ScoreReport::of(&job, evaluator, precision, episodes);
        self.hold(key, Some(run.hand_back(&job).with_scores(report.clone())));
        run.keep(report);
        self.deliver(key, run).await
    }

    async fn deliver(&self, key: &RunKey, run: &mut RunClient) -> anyhow::Result<()> {
        run.deliver().await?;
        self.hold(key, None);
        Ok(())
    }

    fn hold(&self, key: &RunKey, job: Option<HandBack>) {
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        match job {
            Some(job) => drop(held.insert(key.clone(), job)),
            None => drop(held.remove(key)),
        }
    }

    async fn measure(&mut self, name: &Name, job: &Job, run: &RunClient) -> anyhow::Result<Vec<EpisodeScore>> {
        let spec = job::check(job, name).inspect_err(|error| self.metrics.rejected(error.label()))?;
        let metrics = self.metrics.clone();
        let policy = {
            // The learner grants some time for this, as long as it hears that somebody is at it.
            run.tell(job, heartbeat(job), (0, 0)).await;
            let mut loading = std::pin::pin!(self.policy(job, run));
            loop {
                tokio::select! {
                    policy = &mut loading => break policy?,
                    () = tokio::time::sleep(heartbeat(job)) => run.tell(job, heartbeat(job), (0, 0)).await,
                }
            }
        };
        job::check_cost(job, policy.as_ref()).inspect_err(|error| metrics.rejected(error.label()))?;
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
        let mut running = Running::start(job, spec, policy, self.metrics.clone());
        let mut told = 0;
        loop {
            let finished = running.finished_within(heartbeat(job)).await;
            let steps = running.steps_done();
            // Nothing to tell yet is told, too: the first step of a large policy takes its time.
            if steps > told {
                self.beat.alive();
            }
            if steps > told || (steps == 0 && finished.is_none()) {
                told = steps;
                run.tell(job, heartbeat(job), (steps, running.episodes_done())).await;
            }
            if let Some(episodes) = finished {
                return episodes;
            }
        }
    }
}

fn heartbeat(job: &Job) -> Duration {
    Duration::from_millis(job.progress_milliseconds).clamp(HEARTBEAT[0], HEARTBEAT[1])
}

#[cfg(test)]
mod tests;
