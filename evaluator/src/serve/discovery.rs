//! Finds the runs: every learner announces its run with a liveliness token.

use std::collections::BTreeMap;
use std::convert::Infallible;

use anyhow::Context;
use quad_protocol::{Name, keys};
use quad_service::{Certificates, Endpoints, open_session};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::{info, warn};
use zenoh::Session;
use zenoh::sample::SampleKind;

/// A run as one endpoint shows it: the endpoint's place on the command line, and the run's name.
///
/// Seen through two endpoints, a run is served through both: either may fail on its own.
pub type RunKey = (usize, Name);

/// The runs whose learner is there, and the session that reaches it.
pub type Runs = BTreeMap<RunKey, Session>;

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
    pub fn start(endpoints: Vec<String>, certificates: Option<&Certificates>) -> Discovery {
        let (found, runs) = watch::channel(Runs::new());
        let mut tasks = JoinSet::new();
        for (index, endpoint) in endpoints.into_iter().enumerate() {
            tasks.spawn(watch_endpoint(index, endpoint, certificates.cloned(), found.clone()));
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
    loop {
        let token =
            tokens.recv_async().await.map_err(|error| anyhow::anyhow!(error)).context("the Zenoh session closed")?;
        let Some(run) = keys::run_of(token.key_expr().as_str()) else {
            warn!(key = %token.key_expr(), "a learner announced itself under a name that is not allowed");
            continue;
        };
        found.send_modify(|runs| match token.kind() {
            SampleKind::Put => {
                info!(%run, endpoint, "found a run");
                runs.insert((index, run), session.clone());
            }
            SampleKind::Delete => {
                info!(%run, endpoint, "the run's learner is gone");
                runs.remove(&(index, run));
            }
        });
    }
}
