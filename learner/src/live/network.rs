//! Brings a run online: opens the session while training begins, and declares everything on it.

use std::time::Duration;

use quad_run::run::{RunDir, RunEndpoints};
use quad_runtime::{Endpoints, SessionError};
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tracing::warn;
use zenoh::Session;

use super::duplicate::Life;
use super::services::Services;
use super::snapshots::RETRY;
use super::wire::Wire;

/// Listening takes milliseconds. If the session takes longer, it waits for a router, and training starts without it.
const SESSION_PATIENCE: Duration = Duration::from_secs(1);

/// A Zenoh session that may still wait for a router.
pub(crate) enum Opening {
    Open(Session),
    Waits(JoinHandle<Result<Session, SessionError>>),
}

/// Starts to open the session. An error at once means that it cannot work, like a port that is in use.
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

/// Declares the run as soon as the session is open, and writes its addresses into its folder. Run this as a task of its own:
/// the search for another learner of the name takes seconds, and Zenoh may block a task.
pub(super) async fn go_online(
    opening: Opening,
    endpoints: Endpoints,
    life: Life,
    services: Services,
    run_dir: RunDir,
    metrics_address: String,
) -> anyhow::Result<Online> {
    let session = match opening {
        Opening::Open(session) => session,
        Opening::Waits(opening) => opening.await??,
    };
    let reachable_at = quad_runtime::reachable_at(&session, &endpoints).await?;
    let wire = Wire::declare(session, &life, &services).await?;
    let page = format!("http://{metrics_address}/");
    tokio::spawn(write_endpoints(
        run_dir,
        RunEndpoints { zenoh: reachable_at.clone(), metrics: metrics_address, page },
    ));
    Ok(Online { wire, reachable_at })
}

/// Writes where the learner can be reached, as soon as the disk accepts it. Only the user's scripts need the file.
async fn write_endpoints(run_dir: RunDir, endpoints: RunEndpoints) {
    let mut said = false;
    loop {
        let (run_dir, endpoints) = (run_dir.clone(), endpoints.clone());
        match tokio::task::spawn_blocking(move || run_dir.write_endpoints(&endpoints)).await {
            Ok(Err(error)) if !said => {
                said = true;
                warn!("{:#}; it is tried again until the disk takes it", anyhow::Error::from(error));
            }
            Ok(Err(_)) => {}
            Ok(Ok(())) | Err(_) => return,
        }
        tokio::time::sleep(RETRY).await;
    }
}
