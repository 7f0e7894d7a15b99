//! Connects a run: opens the session while training begins, and declares everything on it.
//! Zenoh's callbacks run on Zenoh's threads and must not wait, which would delay their whole
//! connection: they pass queries to our threads, and record messages that need no answer.

use std::future::ready;
use std::time::Duration;

use quad_protocol::keys;
use quad_run::folder::{RunDir, RunEndpoints};
use quad_runtime::{Endpoints, SessionError, open_session};
use tokio::task::{JoinHandle, spawn_blocking};
use tokio::time::{sleep, timeout};
use tracing::{debug, warn};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::Query;

use super::duplicate::{self, Incarnation};
use super::requests::Request;
use super::services::Services;
use super::snapshots::RETRY;

/// Listening takes milliseconds. If the session takes longer, it waits for a router, and training
/// starts without it.
const SESSION_PATIENCE: Duration = Duration::from_secs(1);

/// A Zenoh session that may still wait for a router.
pub(crate) type OpeningSession = JoinHandle<Result<Session, SessionError>>;

/// Starts to open the session. An error at once means that it cannot work, like a port that is in
/// use.
pub(crate) async fn open_network(endpoints: &Endpoints) -> anyhow::Result<OpeningSession> {
    let endpoints = endpoints.clone();
    let mut opening = tokio::spawn(async move { open_session(&endpoints).await });
    match timeout(SESSION_PATIENCE, &mut opening).await {
        Ok(session) => Ok(tokio::spawn(ready(Ok(session??)))),
        Err(_) => Ok(opening),
    }
}

/// A run that evaluators can find.
pub(super) struct Connected {
    pub wire: Wire,
    /// Endpoints for evaluators.
    pub reachable_at: Vec<String>,
}

/// Declares the run as soon as the session is open, and writes its addresses into its folder. Run
/// this as a separate task: the search for another learner of the name takes seconds, and Zenoh may
/// block a task.
pub(super) async fn connect(
    opening: OpeningSession,
    endpoints: Endpoints,
    incarnation: Incarnation,
    services: Services,
    run_dir: RunDir,
    metrics: String,
) -> anyhow::Result<Connected> {
    let session = opening.await??;
    let reachable_at = quad_runtime::reachable_at(&session, &endpoints).await?;
    let wire = Wire::declare(session, &incarnation, &services).await?;
    let page = format!("http://{metrics}/");
    let endpoints = RunEndpoints { zenoh: reachable_at.clone(), metrics, page };
    tokio::spawn(write_endpoints(run_dir, endpoints));
    Ok(Connected { wire, reachable_at })
}

/// Writes the learner's addresses as soon as the disk accepts them. Only the user's scripts need
/// the file.
async fn write_endpoints(run_dir: RunDir, endpoints: RunEndpoints) {
    let mut warned = false;
    loop {
        let (run_dir, endpoints) = (run_dir.clone(), endpoints.clone());
        match spawn_blocking(move || run_dir.write_endpoints(&endpoints)).await {
            Ok(Err(error)) if !warned => {
                let error = anyhow::Error::from(error);
                warn!("{error:#}; it is tried again until the disk takes it");
                warned = true;
            }
            Ok(Err(_)) => {}
            Ok(Ok(())) | Err(_) => return,
        }
        sleep(RETRY).await;
    }
}

/// The learner's session and its token. All else that is declared ends with the session.
pub(super) struct Wire {
    session: Session,
    _token: LivelinessToken,
}

impl Wire {
    /// Declares the queryables, then the subscribers, and last the learner's liveliness token, so
    /// that an evaluator that sees the token finds everything else ready.
    ///
    /// # Errors
    /// Another learner has the run's name, which takes some seconds to find out; or Zenoh fails.
    pub async fn declare(
        session: Session,
        incarnation: &Incarnation,
        services: &Services,
    ) -> anyhow::Result<Self> {
        duplicate::wait_until_gone(&session, incarnation).await?;
        let run = &incarnation.run;
        services.weights.connected(&session);
        serve(&session, keys::weights_at(run, keys::ANY), services, Services::weights).await?;
        serve(&session, keys::jobs(run), services, Services::job).await?;
        serve(&session, keys::scores(run), services, Services::scores).await?;
        serve(&session, keys::experience(run), services, Services::experience).await?;
        let zenoh = anyhow::Error::from_boxed;
        let receiver = services.clone();
        let progress = session
            .declare_subscriber(keys::progress(run, keys::ANY))
            .callback(move |sample| receiver.progress(&sample));
        progress.background().await.map_err(zenoh)?;
        let (receiver, liveliness) = (services.clone(), session.liveliness());
        let evaluators = liveliness
            .declare_subscriber(keys::live_evaluator(run, keys::ANY))
            .history(true)
            .callback(move |token| receiver.evaluator(&token));
        evaluators.background().await.map_err(zenoh)?;
        let token = liveliness.declare_token(keys::live_learner(run, incarnation.number));
        let token = token.await.map_err(zenoh)?;
        // Of two learners that start at once, neither may have seen the other.
        duplicate::watch(&session, incarnation, &services.carrier.events).await?;
        Ok(Self { session, _token: token })
    }

    /// Closes the session; Zenoh still delivers earlier answers.
    pub async fn close(self) {
        if let Err(error) = self.session.close().await {
            debug!(%error, "the session did not close");
        }
    }
}

async fn serve(
    session: &Session,
    key: String,
    services: &Services,
    answer: fn(&Services, Request),
) -> anyhow::Result<()> {
    let services = services.clone();
    let callback = move |query: Query| answer(&services, Request::new(query));
    // Complete: an evaluator that asks only for the best answer asks here, too.
    let queryable = session.declare_queryable(key).complete(true).callback(callback);
    queryable.background().await.map_err(anyhow::Error::from_boxed)
}
