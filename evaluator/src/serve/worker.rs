//! The evaluator's main loop: serves the runs in turn, one job at a time.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::Context;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::warn;

use super::client::{ANSWER_TIMEOUT, RunClient};
use super::discovery::{RunKey, Runs};
use super::evaluate::Evaluator;
use super::scheduler;
use super::snapshot::Snapshots;
use crate::metrics::Metrics;

/// How long scores are kept for a learner that is gone, perhaps only disconnected.
const KEEP_SCORES: Duration = Duration::from_secs(600);

/// Serves all runs, one job at a time.
pub struct Worker {
    evaluator: Evaluator,
    metrics: Metrics,
    found: watch::Receiver<Runs>,
    /// The runs that it serves, and runs whose learner is gone but may come back for its scores.
    clients: BTreeMap<RunKey, RunClient>,
    snapshots: Snapshots,
}

impl Worker {
    /// A worker for the runs that `found` names.
    pub fn new(evaluator: Evaluator, metrics: Metrics, found: watch::Receiver<Runs>) -> Worker {
        Worker {
            evaluator,
            metrics,
            found,
            clients: BTreeMap::new(),
            snapshots: Snapshots::default(),
        }
    }

    /// Serves until `stop` is ready, and returns its result. Then hands an unfinished job back, and
    /// delivers scores that were not acknowledged.
    pub async fn run(
        mut self,
        stop: impl Future<Output = anyhow::Result<()>>,
    ) -> anyhow::Result<()> {
        let result = tokio::select! {
            biased;
            result = stop => result,
            error = self.work() => Err(error),
        };
        self.follow_learners();
        let leaving = JoinSet::from_iter(self.clients.into_values().map(RunClient::leave));
        leaving.join_all().await;
        result
    }

    async fn work(&mut self) -> anyhow::Error {
        loop {
            self.evaluator.beat.alive();
            self.follow_learners();
            self.attach().await;
            self.metrics.runs.set(self.clients.len() as i64);
            let there = self.clients.iter().filter(|(_, client)| client.gone.is_none());
            let next =
                scheduler::next(there.map(|(key, client)| (key, &client.turn)), Instant::now());
            match next.cloned() {
                Some(key) => self.turn(&key).await,
                None => {
                    if let Err(error) = self.wait().await {
                        return error;
                    }
                }
            }
        }
    }

    /// Follows the learners of its runs, and stops serving runs whose learners are gone.
    fn follow_learners(&mut self) {
        let (found, now) = (self.found.borrow_and_update(), Instant::now());
        let over = |(key, client): (&RunKey, &mut RunClient)| {
            match found.get(key) {
                Some(learner) => client.follow(&learner.incarnations),
                None if client.owes() && now - *client.gone.get_or_insert(now) < KEEP_SCORES => {}
                None => return Some(key.clone()),
            }
            None
        };
        let over: Vec<RunKey> = self.clients.iter_mut().filter_map(over).collect();
        for client in over.iter().filter_map(|key| self.clients.remove(key)) {
            client.give_up();
        }
    }

    /// Starts to serve new runs.
    async fn attach(&mut self) {
        let found = self.found.borrow().clone();
        for (key, learner) in
            found.iter().filter(|(key, _)| !self.clients.contains_key(*key)).collect::<Vec<_>>()
        {
            let (name, snapshots) = (self.evaluator.name.clone(), self.snapshots.clone());
            match RunClient::attach(key.1.clone(), learner, name, snapshots, self.metrics.clone())
                .await
            {
                Ok(client) => drop(self.clients.insert(key.clone(), client)),
                Err(error) => warn!("{error:#}"),
            }
        }
    }

    /// Waits until a run is due, runs come or go, or a new snapshot promises work.
    async fn wait(&mut self) -> anyhow::Result<()> {
        let due = self.clients.values().map(|client| match client.gone {
            None => client.turn.ready_at(),
            Some(since) => since + KEEP_SCORES,
        });
        let latest = Instant::now() + self.evaluator.beat.interval();
        let until = due.min().map_or(latest, |due| due.min(latest));
        tokio::select! {
            () = tokio::time::sleep_until(until.into()) => {}
            changed = self.found.changed() => changed.context("the search for learners has ended")?,
            () = self.snapshots.arrival() => self.clients.values_mut().for_each(RunClient::wake_for_snapshot),
        }
        Ok(())
    }

    /// Takes one turn of a run.
    async fn turn(&mut self, key: &RunKey) {
        let Some(client) = self.clients.get_mut(key) else { return };
        if let Err(error) = serve(client, &mut self.evaluator).await {
            client.back_off(&error);
            if let Some(learner) = self.found.borrow().get(key) {
                client.follow_next(&learner.incarnations);
            }
        }
    }
}

/// Delivers what the evaluator owes, if anything, else runs one job.
async fn serve(client: &mut RunClient, evaluator: &mut Evaluator) -> anyhow::Result<()> {
    if !client.owes() {
        let Some(job) = client.claim(evaluator.environments.names()).await? else { return Ok(()) };
        match evaluator.evaluate(&job, client).await {
            Ok(report) => client.keep(report),
            Err(error) => {
                client.fail(&format!("{error:#}")).await;
                return Err(error.context(format!("a job of step {} failed", job.step)));
            }
        }
    }
    client.deliver(ANSWER_TIMEOUT).await
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use quad_policy::Precision;
    use quad_protocol::Name;
    use quad_runtime::Health;

    use super::*;
    use crate::sim::Simulations;

    #[tokio::test(flavor = "multi_thread")]
    async fn an_evaluator_without_work_is_well() {
        let (health, (_keep, found)) = (Health::default(), watch::channel(Runs::new()));
        let (name, metrics, limit) =
            (Name::new("idle").unwrap(), Metrics::new().unwrap(), Duration::from_secs(1));
        let (environments, beat) = (Arc::new(Simulations), health.register("worker", limit));
        let evaluator = Evaluator::new(name, environments, Precision::F32, metrics.clone(), beat);
        // One that says nothing is not well any more by then, and stays so.
        let stop = async {
            tokio::time::sleep(2 * limit).await;
            while !health.problems().is_empty() {
                tokio::time::sleep(limit / 20).await;
            }
            Ok(())
        };
        let served = Worker::new(evaluator, metrics, found).run(stop);
        tokio::time::timeout(Duration::from_secs(120), served).await.expect("it is well").unwrap();
    }
}
