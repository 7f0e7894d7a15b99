//! Finds the runs: every learner announces its run with a liveliness token.

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;

use anyhow::Context;
use quad_protocol::{Name, keys};
use quad_service::{Certificates, Endpoints, open_session};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::{debug, info, warn};
use zenoh::Session;
use zenoh::sample::{Sample, SampleKind};

use crate::metrics::Metrics;

/// Most runs that are served at a time, and most learners of one run that are told apart: for floods of made-up ones.
const MOST_RUNS: usize = 64;
const MOST_LIVES: usize = 8;

/// A run as one endpoint shows it: the endpoint's place on the command line, and the run's name.
///
/// Seen through two endpoints, a run is served through both: either may fail on its own.
pub type RunKey = (usize, Name);

/// A run whose learner is there.
#[derive(Clone)]
pub struct Found {
    /// The session that reaches it.
    pub session: Session,
    /// The incarnations that announce themselves, at least one: a learner that was cut off or killed may still seem to be
    /// there when the next one starts.
    pub lives: BTreeSet<u64>,
}

/// The runs that are there.
pub type Runs = BTreeMap<RunKey, Found>;

/// Watches every endpoint for as long as it lives.
pub struct Discovery {
    runs: watch::Receiver<Runs>,
    tasks: JoinSet<anyhow::Result<Infallible>>,
}

impl Discovery {
    /// Starts to watch; endpoints that nobody listens at yet are waited for.
    ///
    /// Each endpoint gets a session of its own, because a Zenoh client keeps one connection: with one session,
    /// a second learner's endpoint would only be a spare for the first.
    pub fn start(endpoints: Vec<String>, certificates: Option<&Certificates>, metrics: &Metrics) -> Discovery {
        let (found, runs) = watch::channel(Runs::new());
        let mut tasks = JoinSet::new();
        for (index, endpoint) in endpoints.into_iter().enumerate() {
            tasks.spawn(watch_endpoint(index, endpoint, certificates.cloned(), found.clone(), metrics.clone()));
        }
        Discovery { runs, tasks }
    }

    /// The runs that are there, as they come and go.
    pub fn runs(&self) -> watch::Receiver<Runs> {
        self.runs.clone()
    }

    /// Waits until an endpoint cannot be watched any more, which only a wrong endpoint or a bug causes.
    pub async fn failed(&mut self) -> anyhow::Error {
        match self.tasks.join_next().await {
            Some(Ok(Err(error))) => error,
            Some(Err(error)) => anyhow::Error::new(error).context("the search for learners broke off"),
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
    let endpoints = Endpoints { connect: vec![endpoint.clone()], certificates, ..Endpoints::default() };
    let session = open_session(&endpoints).await?;
    info!(endpoint, "connected");
    let tokens = session
        .liveliness()
        .declare_subscriber(keys::ALL_LEARNERS)
        .history(true)
        .await
        .map_err(|error| anyhow::anyhow!(error))
        .with_context(|| format!("cannot look for learners at {endpoint}"))?;
    let mut warned = false;
    loop {
        let token =
            tokens.recv_async().await.map_err(|error| anyhow::anyhow!(error)).context("the Zenoh session closed")?;
        let mut problem = None;
        found.send_if_modified(|runs| match follow(runs, index, &session, &token) {
            Ok(changed) => changed,
            Err(label) => {
                problem = Some(label);
                false
            }
        });
        let Some(label) = problem else { continue };
        metrics.rejected(label);
        match std::mem::replace(&mut warned, true) {
            false => warn!(endpoint, key = %token.key_expr(), label, "a learner is not served; more are only counted"),
            true => debug!(endpoint, key = %token.key_expr(), label, "a learner is not served"),
        }
    }
}

/// Takes in a token; says whether the runs have changed, or why it is not taken in.
fn follow(runs: &mut Runs, index: usize, session: &Session, token: &Sample) -> Result<bool, &'static str> {
    let key = token.key_expr().as_str();
    let (run, incarnation) = keys::run_of(key).zip(keys::incarnation_of(key)).ok_or("invalid_name")?;
    let place = (index, run.clone());
    let count = runs.len();
    match (token.kind(), runs.get_mut(&place)) {
        (SampleKind::Put, None) if count >= MOST_RUNS => Err("too_many_runs"),
        (SampleKind::Put, None) => {
            info!(%run, incarnation, "found a run");
            runs.insert(place, Found { session: session.clone(), lives: BTreeSet::from([incarnation]) });
            Ok(true)
        }
        (SampleKind::Put, Some(found)) if found.lives.len() >= MOST_LIVES => Err("too_many_learners"),
        (SampleKind::Put, Some(found)) => Ok(found.lives.insert(incarnation)),
        (SampleKind::Delete, None) => Ok(false),
        (SampleKind::Delete, Some(found)) => {
            let changed = found.lives.remove(&incarnation);
            if found.lives.is_empty() {
                info!(%run, incarnation, "the run's learner is gone");
                runs.remove(&place);
            }
            Ok(changed)
        }
    }
}
