//! Brings a run online: opens the session while training begins, and declares everything on it.
//! Zenoh's callbacks run on Zenoh's threads and must not wait, which would delay their whole
//! connection: they pass queries to our threads, and record messages that need no answer.

use std::time::Duration;

use quad_protocol::keys;
use quad_run::folder::{RunDir, RunEndpoints};
use quad_runtime::{Endpoints, SessionError};
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tracing::{debug, warn};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Subscriber;
use zenoh::query::{Query, Queryable};

use super::duplicate::{self, Incarnation};
use super::requests::Request;
use super::services::Services;
use super::snapshots::RETRY;

/// Listening takes milliseconds. If the session takes longer, it waits for a router, and training
/// starts without it.
const SESSION_PATIENCE: Duration = Duration::from_secs(1);

/// A Zenoh session that may still wait for a router.
pub(crate) enum Opening {
    Open(Session),
    Waits(JoinHandle<Result<Session, SessionError>>),
}

/// Starts to open the session. An error at once means that it cannot work, like a port that is in
/// use.
pub(crate) async fn open_network(endpoints: &Endpoints) -> anyhow::Result<Opening> {
    let endpoints = endpoints.clone();
    let mut opening = tokio::spawn(async move { quad_runtime::open_session(&endpoints).await });
    match timeout(SESSION_PATIENCE, &mut opening).await {
        Ok(session) => Ok(Opening::Open(session??)),
        Err(_) => Ok(Opening::Waits(opening)),
    }
}

/// A run that evaluators can find.
pub(super) struct Online {
    pub wire: Wire,
    /// Where evaluators can reach it.
    pub reachable_at: Vec<String>,
}

/// Declares the run as soon as the session is open, and writes its addresses into its folder. Run
/// this as a task of its own: the search for another learner of the name takes seconds, and Zenoh
/// may block a task.
pub(super) async fn go_online(
    opening: Opening,
    endpoints: Endpoints,
    incarnation: Incarnation,
    services: Services,
    run_dir: RunDir,
    metrics_address: String,
) -> anyhow::Result<Online> {
    let session = match opening {
        Opening::Open(session) => session,
        Opening::Waits(opening) => opening.await??,
    };
    let reachable_at = quad_runtime::reachable_at(&session, &endpoints).await?;
    let wire = Wire::declare(session, &incarnation, &services).await?;
    let page = format!("http://{metrics_address}/");
    tokio::spawn(write_endpoints(
        run_dir,
        RunEndpoints { zenoh: reachable_at.clone(), metrics: metrics_address, page },
    ));
    Ok(Online { wire, reachable_at })
}

/// Writes where the learner can be reached, as soon as the disk accepts it. Only the user's scripts
/// need the file.
async fn write_endpoints(run_dir: RunDir, endpoints: RunEndpoints) {
    let mut said = false;
    loop {
        let (run_dir, endpoints) = (run_dir.clone(), endpoints.clone());
        match tokio::task::spawn_blocking(move || run_dir.write_endpoints(&endpoints)).await {
            Ok(Err(error)) if !said => {
                said = true;
                warn!(
                    "{:#}; it is tried again until the disk takes it",
                    anyhow::Error::from(error)
                );
            }
            Ok(Err(_)) => {}
            Ok(Ok(())) | Err(_) => return,
        }
        tokio::time::sleep(RETRY).await;
    }
}

/// The learner's declarations; dropping it undeclares them.
pub(super) struct Wire {
    session: Session,
    _queryables: [Queryable<()>; 3],
    _subscribers: [Subscriber<()>; 2],
    _token: LivelinessToken,
}

impl Wire {
    /// Declares the queryables, then the subscribers, and last the learner's liveliness token, so
    /// that an evaluator that sees the token finds everything else ready.
    ///
    /// # Errors
    ///
    /// Another learner has the run's name, which takes some seconds to find out; or Zenoh fails.
    pub async fn declare(
        session: Session,
        incarnation: &Incarnation,
        services: &Services,
    ) -> anyhow::Result<Self> {
        duplicate::wait_until_gone(&session, incarnation).await?;
        let run = &incarnation.run;
        services.weights.online(&session);
        let queryables = [
            serve(&session, keys::weights_at_any_step(run), services, Services::weights).await?,
            serve(&session, keys::jobs(run), services, Services::job).await?,
            serve(&session, keys::scores(run), services, Services::report).await?,
        ];
        let told = services.clone();
        let progress = session.declare_subscriber(keys::all_progress(run));
        let progress = progress
            .callback(move |sample| told.progress(&sample))
            .await
            .map_err(anyhow::Error::from_boxed)?;
        let told = services.clone();
        let evaluators =
            session.liveliness().declare_subscriber(keys::all_evaluators(run)).history(true);
        let evaluators = evaluators
            .callback(move |token| told.evaluator(&token))
            .await
            .map_err(anyhow::Error::from_boxed)?;
        let token =
            session.liveliness().declare_token(keys::live_learner(run, incarnation.number)).await;
        let token = token.map_err(anyhow::Error::from_boxed)?;
        // Of two learners that start at once, neither may have seen the other.
        duplicate::watch(&session, incarnation, &services.events).await?;
        Ok(Self {
            session,
            _queryables: queryables,
            _subscribers: [progress, evaluators],
            _token: token,
        })
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
) -> anyhow::Result<Queryable<()>> {
    let services = services.clone();
    let callback = move |query: Query| answer(&services, Request::new(query));
    // Complete: an evaluator that asks only for the best answer asks here, too.
    session
        .declare_queryable(key)
        .complete(true)
        .callback(callback)
        .await
        .map_err(anyhow::Error::from_boxed)
}
