//! Finds the runs: every learner announces its run with a liveliness token.

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::time::Duration;

use anyhow::Context;
use quad_protocol::{Name, keys};
use quad_runtime::{Certificates, Endpoints, open_session};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::{info, warn};
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use super::query::may_block;
use crate::metrics::Metrics;

/// Most learners that an evaluator follows, over all runs and endpoints. The limit bounds memory;
/// it is far above any use.
const MOST_LEARNERS: usize = 1024;
/// How often the evaluator checks that a session is still open.
const GLANCE: Duration = Duration::from_secs(10);

/// A run at one endpoint: the endpoint's place on the command line, and the run's name.
///
/// The evaluator serves a run of two endpoints through both: either may fail on its own.
pub type RunKey = (usize, Name);

/// A run whose learner is connected.
#[derive(Clone)]
pub struct Found {
    /// The session that reaches it.
    pub session: Session,
    /// The incarnations that announce themselves, at least one: the token of a learner that was
    /// disconnected or killed may still exist when the next one starts.
    pub incarnations: BTreeSet<u64>,
}

/// The runs whose learners are connected.
pub type Runs = BTreeMap<RunKey, Found>;

/// Watches every endpoint as long as it lives.
pub struct Discovery {
    runs: watch::Receiver<Runs>,
    tasks: JoinSet<anyhow::Result<Infallible>>,
}

impl Discovery {
    /// Starts to watch. If nothing listens at an endpoint, it waits.
    ///
    /// Each endpoint gets a session of its own, because a Zenoh client keeps one connection: in one
    /// session, a second endpoint would only be a spare for the first.
    pub fn start(
        endpoints: Vec<String>,
        certificates: Option<&Certificates>,
        metrics: &Metrics,
    ) -> Discovery {
        let (found, runs) = watch::channel(Runs::new());
        let mut tasks = JoinSet::new();
        for (index, endpoint) in endpoints.into_iter().enumerate() {
            tasks.spawn(watch_endpoint(
                index,
                endpoint,
                certificates.cloned(),
                found.clone(),
                metrics.clone(),
            ));
        }
        Discovery { runs, tasks }
    }

    /// The current runs, as they come and go.
    pub fn runs(&self) -> watch::Receiver<Runs> {
        self.runs.clone()
    }

    /// Returns only if an endpoint cannot be watched, which means a wrong endpoint or a bug.
    pub async fn failed(&mut self) -> anyhow::Error {
        match self.tasks.join_next().await {
            Some(Ok(Err(error))) => error,
            Some(Err(error)) => {
                anyhow::Error::new(error).context("the search for learners broke off")
            }
            Some(Ok(Ok(never))) => match never {},
            None => std::future::pending().await,
        }
    }
}

async fn watch_endpoint(
    index: usize,
    endpoint: String,
    certificates: Option<Certificates>,
    found: watch::Sender<Runs>,
    metrics: Metrics,
) -> anyhow::Result<Infallible> {
    info!(endpoint, "waiting for a learner or a router");
    let endpoints =
        Endpoints { connect: vec![endpoint.clone()], certificates, ..Endpoints::default() };
    let session = open_session(&endpoints).await?;
    info!(endpoint, "connected");
    let told = session.clone();
    let callback = move |token: Sample| {
        found.send_if_modified(|runs| {
            take_in(runs, (index, &told), token.kind(), token.key_expr().as_str()).unwrap_or_else(
                |label| {
                    metrics.rejected(label);
                    warn!(key = token.key_expr().as_str(), label, "a learner is not served");
                    false
                },
            )
        });
    };
    let declared = session.clone();
    let declare = move || {
        let subscriber = declared.liveliness().declare_subscriber(keys::ALL_LEARNERS).history(true);
        subscriber.callback(callback).wait()
    };
    let subscriber = may_block(declare).await;
    let _subscriber =
        subscriber.with_context(|| format!("cannot look for learners at {endpoint}"))?;
    loop {
        tokio::time::sleep(GLANCE).await;
        anyhow::ensure!(!session.is_closed(), "the Zenoh session closed");
    }
}

/// Records a token. Returns whether the runs have changed, or the label of the reason why it was
/// ignored.
fn take_in(
    runs: &mut Runs,
    (index, session): (usize, &Session),
    kind: SampleKind,
    key: &str,
) -> Result<bool, &'static str> {
    let (run, incarnation) =
        keys::run_of(key).zip(keys::incarnation_of(key)).ok_or("invalid_name")?;
    let learners: usize = runs.values().map(|found| found.incarnations.len()).sum();
    let place = (index, run);
    let run = &place.1;
    match (kind, runs.get_mut(&place)) {
        (SampleKind::Put, _) if learners >= MOST_LEARNERS => Err("too_many_runs"),
        (SampleKind::Put, Some(found)) => Ok(found.incarnations.insert(incarnation)),
        (SampleKind::Put, None) => {
            info!(%run, incarnation, "found a run");
            runs.insert(
                place,
                Found { session: session.clone(), incarnations: BTreeSet::from([incarnation]) },
            );
            Ok(true)
        }
        (SampleKind::Delete, None) => Ok(false),
        (SampleKind::Delete, Some(found)) => {
            let changed = found.incarnations.remove(&incarnation);
            if found.incarnations.is_empty() {
                info!(%run, incarnation, "the run's learner has left or lost its connection");
                runs.remove(&place);
            }
            Ok(changed)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(flavor = "multi_thread")]
    async fn learners_are_followed_up_to_a_bound() {
        let endpoints =
            Endpoints { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..Endpoints::default() };
        let session = open_session(&endpoints).await.unwrap();
        let mut runs = Runs::new();
        let mut tell = |kind, run: usize, incarnation: usize| {
            let result = take_in(
                &mut runs,
                (0, &session),
                kind,
                &format!("quad/run-{run}/live/learner/{incarnation}"),
            );
            (result, runs.len())
        };
        assert_eq!(tell(SampleKind::Put, 0, 1), (Ok(true), 1));
        assert_eq!(tell(SampleKind::Put, 0, 1), (Ok(false), 1), "it is known");
        assert_eq!(
            tell(SampleKind::Put, 0, 2),
            (Ok(true), 1),
            "the next incarnation, while the first seems to be there"
        );
        for run in 2..MOST_LEARNERS {
            assert_eq!(tell(SampleKind::Put, run, 1), (Ok(true), run));
        }
        assert_eq!(tell(SampleKind::Put, MOST_LEARNERS, 1).0, Err("too_many_runs"));
        assert_eq!(tell(SampleKind::Put, 0, 3).0, Err("too_many_runs"));
        assert_eq!(tell(SampleKind::Delete, 0, 1), (Ok(true), MOST_LEARNERS - 1));
        assert_eq!(
            tell(SampleKind::Delete, 0, 2),
            (Ok(true), MOST_LEARNERS - 2),
            "the last incarnation is gone"
        );
        assert_eq!(tell(SampleKind::Delete, MOST_LEARNERS, 1), (Ok(false), MOST_LEARNERS - 2));
        assert_eq!(
            tell(SampleKind::Put, MOST_LEARNERS, 1),
            (Ok(true), MOST_LEARNERS - 1),
            "there is room again"
        );
    }
}
