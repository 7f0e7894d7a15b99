//! Finds the runs: every learner announces its run with a liveliness token.

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::time::Duration;

use anyhow::Context;
use quad_protocol::{Name, keys};
use quad_runtime::{Endpoints, Hint, SessionError, open_session};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::{info, warn};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use super::connection::blocking;
use crate::metrics::Metrics;

/// Most learners that an evaluator follows, over all runs and endpoints: a bound on memory, far
/// above any use.
const MAX_LEARNERS: usize = 1024;
/// Interval of checks that a session is still open.
const CHECK_INTERVAL: Duration = Duration::from_secs(10);

/// Index of an endpoint on the command line, and a run's name. A run of two endpoints is served
/// through both, because either may fail.
pub type RunKey = (usize, Name);

/// A run's learners that are connected.
#[derive(Clone)]
pub struct Learners {
    pub session: Session,
    /// The announced learner processes, at least one. The token of a killed learner may still exist
    /// when the next one starts.
    pub incarnations: BTreeSet<u64>,
}

pub type Runs = BTreeMap<RunKey, Learners>;

/// Watches every endpoint until it is dropped.
pub struct Discovery {
    runs: watch::Receiver<Runs>,
    tasks: JoinSet<anyhow::Result<Infallible>>,
}

impl Discovery {
    /// Starts to watch. If nothing listens at an endpoint, it waits.
    ///
    /// Each endpoint gets its own session, because a Zenoh client keeps one connection: in one
    /// session, a second endpoint would only be a spare.
    pub fn start(endpoints: &Endpoints, metrics: &Metrics) -> Discovery {
        let (tx, runs) = watch::channel(Runs::new());
        let watch = |(index, endpoint): (usize, &String)| {
            let endpoints = Endpoints { connect: vec![endpoint.clone()], ..endpoints.clone() };
            watch_endpoint(index, endpoints, tx.clone(), metrics.clone())
        };
        let mut tasks = JoinSet::new();
        endpoints.connect.iter().enumerate().map(watch).for_each(|task| drop(tasks.spawn(task)));
        Discovery { runs, tasks }
    }

    pub fn runs(&self) -> watch::Receiver<Runs> {
        self.runs.clone()
    }

    /// Returns only if an endpoint cannot be watched: a wrong endpoint or a bug.
    pub async fn failed(&mut self) -> anyhow::Error {
        match self.tasks.join_next().await {
            Some(Ok(Err(error))) => error,
            Some(Err(error)) => anyhow::Error::new(error).context("the search for learners failed"),
            Some(Ok(Ok(never))) => match never {},
            None => std::future::pending().await,
        }
    }
}

async fn watch_endpoint(
    index: usize,
    endpoints: Endpoints,
    tx: watch::Sender<Runs>,
    metrics: Metrics,
) -> anyhow::Result<Infallible> {
    let endpoint = &endpoints.connect[0];
    info!(endpoint, "waiting for a learner or a router");
    let session = open_session(&endpoints).await.hint_of(SessionError::hint)?;
    info!(endpoint, "connected");
    let (served, declarer) = (session.clone(), session.clone());
    let callback = move |token: Sample| {
        let key = token.key_expr().as_str();
        tx.send_if_modified(|runs| {
            update(runs, (index, &served), token.kind(), key).unwrap_or_else(|label| {
                metrics.rejected(label);
                warn!(key, label, "a learner is not served");
                false
            })
        });
    };
    let declare = move || {
        let liveliness = declarer.liveliness();
        let subscriber = liveliness.declare_subscriber(keys::ALL_LEARNERS);
        subscriber.history(true).callback(callback).wait()
    };
    let subscriber = blocking(declare).await;
    let _subscriber =
        subscriber.with_context(|| format!("cannot look for learners at {endpoint}"))?;
    loop {
        tokio::time::sleep(CHECK_INTERVAL).await;
        anyhow::ensure!(!session.is_closed(), "the Zenoh session closed");
    }
}

/// Applies a token. Returns whether the runs have changed; an error is the label of the reason why
/// the token was ignored.
fn update(
    runs: &mut Runs,
    (index, session): (usize, &Session),
    kind: SampleKind,
    key: &str,
) -> Result<bool, &'static str> {
    let ids = keys::run_of(key).zip(keys::incarnation_of(key));
    let (run, incarnation) = ids.ok_or("invalid_name")?;
    let count: usize = runs.values().map(|learners| learners.incarnations.len()).sum();
    let key = (index, run);
    let run = &key.1;
    match (kind, runs.get_mut(&key)) {
        (SampleKind::Put, _) if count >= MAX_LEARNERS => Err("too_many_runs"),
        (SampleKind::Put, Some(learners)) => Ok(learners.incarnations.insert(incarnation)),
        (SampleKind::Put, None) => {
            info!(%run, incarnation, "found a run");
            let (session, incarnations) = (session.clone(), BTreeSet::from([incarnation]));
            runs.insert(key, Learners { session, incarnations });
            Ok(true)
        }
        (SampleKind::Delete, None) => Ok(false),
        (SampleKind::Delete, Some(learners)) => {
            let changed = learners.incarnations.remove(&incarnation);
            if learners.incarnations.is_empty() {
                info!(%run, incarnation, "the run's learner has left or lost its connection");
                runs.remove(&key);
            }
            Ok(changed)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use SampleKind::{Delete, Put};

    #[tokio::test(flavor = "multi_thread")]
    async fn follows_learners_up_to_a_limit() {
        let listen = vec!["tcp/127.0.0.1:0".to_owned()];
        let endpoints = Endpoints { listen, ..Endpoints::default() };
        let session = open_session(&endpoints).await.unwrap();
        let mut runs = Runs::new();
        let mut update = |kind, run: usize, incarnation: usize| {
            let key = format!("quad/run-{run}/live/learner/{incarnation}");
            (update(&mut runs, (0, &session), kind, &key), runs.len())
        };
        const MAX: usize = MAX_LEARNERS;
        assert_eq!(update(Put, 0, 1), (Ok(true), 1));
        assert_eq!(update(Put, 0, 1), (Ok(false), 1), "again");
        assert_eq!(update(Put, 0, 2), (Ok(true), 1), "the next incarnation");
        for run in 2..MAX {
            assert_eq!(update(Put, run, 1), (Ok(true), run));
        }
        assert_eq!(update(Put, MAX, 1).0, Err("too_many_runs"));
        assert_eq!(update(Put, 0, 3).0, Err("too_many_runs"));
        assert_eq!(update(Delete, 0, 1), (Ok(true), MAX - 1));
        assert_eq!(update(Delete, 0, 2), (Ok(true), MAX - 2), "the run is gone");
        assert_eq!(update(Delete, MAX, 1), (Ok(false), MAX - 2));
        assert_eq!(update(Put, MAX, 1), (Ok(true), MAX - 1), "there is room");
    }
}
