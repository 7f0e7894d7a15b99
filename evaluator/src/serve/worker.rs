//! The evaluator's main loop: serves the runs in turn, one job at a time.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::Context;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::warn;

use super::client::RunClient;
use super::discovery::{RunKey, Runs};
use super::evaluate::Evaluator;
use super::scheduler;
use super::snapshot::Snapshots;

/// Time that results are kept for a learner that is gone, perhaps only disconnected.
const KEEP_RESULTS: Duration = Duration::from_secs(600);

/// Serves all runs, one job at a time.
pub struct Worker {
    evaluator: Evaluator,
    runs: watch::Receiver<Runs>,
    /// Runs with a learner, and runs whose learner is gone but may come back for its results.
    clients: BTreeMap<RunKey, RunClient>,
    snapshots: Snapshots,
}

impl Worker {
    pub fn new(evaluator: Evaluator, runs: watch::Receiver<Runs>) -> Worker {
        Worker { evaluator, runs, clients: BTreeMap::new(), snapshots: Snapshots::default() }
    }

    /// Serves until `stop` is ready, and returns its result. Then delivers results that were not
    /// acknowledged, and hands unfinished jobs back.
    pub async fn run(
        mut self,
        stop: impl Future<Output = anyhow::Result<()>>,
    ) -> anyhow::Result<()> {
        let result = tokio::select! {
            biased;
            result = stop => result,
            error = self.work() => error,
        };
        self.follow_learners();
        let leaving = JoinSet::from_iter(self.clients.into_values().map(RunClient::leave));
        leaving.join_all().await;
        result
    }

    /// Returns only an error.
    async fn work(&mut self) -> anyhow::Result<()> {
        loop {
            self.evaluator.beat.alive();
            self.follow_learners();
            self.attach().await;
            self.evaluator.metrics.runs.set(self.clients.len() as i64);
            let clients = self.clients.iter();
            let connected = clients.filter(|(_, client)| client.gone.is_none());
            let turns = connected.map(|(key, client)| (key, client.duty.turn()));
            match scheduler::next(turns, Instant::now()).cloned() {
                Some(key) => self.take_turn(&key).await,
                None => self.wait().await?,
            }
        }
    }

    /// Follows the learners of its runs, and stops serving runs whose learners are gone.
    fn follow_learners(&mut self) {
        let (runs, now) = (self.runs.borrow_and_update(), Instant::now());
        let is_over = |key: &RunKey, client: &mut RunClient| {
            if let Some(learners) = runs.get(key) {
                client.follow(&learners.incarnations);
                return false;
            }
            let gone = now - *client.gone.get_or_insert(now);
            !client.duty.owes() || gone >= KEEP_RESULTS
        };
        for (_, client) in self.clients.extract_if(.., is_over) {
            client.give_up();
        }
    }

    /// Starts to serve new runs.
    async fn attach(&mut self) {
        let runs = self.runs.borrow().clone();
        for (key, learners) in runs {
            if self.clients.contains_key(&key) {
                continue;
            }
            let Evaluator { name, metrics, .. } = &self.evaluator;
            let (run, snapshots) = (key.clone(), self.snapshots.clone());
            match RunClient::attach(run, &learners, name.clone(), snapshots, metrics.clone()).await
            {
                Ok(client) => drop(self.clients.insert(key, client)),
                Err(error) => warn!("{error:#}"),
            }
        }
    }

    /// Waits until a run is due, runs come or go, or a new snapshot promises work.
    async fn wait(&mut self) -> anyhow::Result<()> {
        let due = self.clients.values().map(|client| match client.gone {
            None => client.duty.turn().ready_at,
            Some(since) => since + KEEP_RESULTS,
        });
        let latest = Instant::now() + self.evaluator.beat.interval();
        let until = due.min().map_or(latest, |due| due.min(latest));
        tokio::select! {
            () = tokio::time::sleep_until(until.into()) => {}
            changed = self.runs.changed() => changed.context("the search for learners has ended")?,
            () = self.snapshots.arrival() => self.clients.values_mut().for_each(RunClient::wake_for_snapshot),
        }
        Ok(())
    }

    async fn take_turn(&mut self, key: &RunKey) {
        let learners = self.runs.borrow().get(key).cloned();
        if let (Some(client), Some(learners)) = (self.clients.get_mut(key), learners) {
            client.duty.begin_turn();
            while let Some(step) = client.duty.next(rand::random()) {
                if let Err(error) = client.take(step, &mut self.evaluator).await {
                    return client.rest(error, &learners.incarnations);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use quad_runtime::Health;

    use super::super::fixtures::evaluator;
    use super::*;

    #[tokio::test(flavor = "multi_thread")]
    async fn an_evaluator_without_work_is_healthy() {
        let (health, limit) = (Health::default(), Duration::from_secs(1));
        let (_tx, runs) = watch::channel(Runs::new());
        let worker = Worker::new(evaluator(&health, limit), runs);
        // A part that never reports is unhealthy by then, and stays so.
        let stop = async {
            tokio::time::sleep(2 * limit).await;
            while !health.problems().is_empty() {
                tokio::time::sleep(limit / 20).await;
            }
            Ok(())
        };
        let served = tokio::time::timeout(Duration::from_secs(120), worker.run(stop)).await;
        served.expect("it is healthy").unwrap();
    }
}
