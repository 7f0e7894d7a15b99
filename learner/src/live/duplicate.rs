//! Two learners with one run name would answer each other's evaluators, so the second learner
//! stops.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::anyhow;
use quad_protocol::{Name, keys};
use quad_runtime::hinted;
use tracing::{debug, info};
use zenoh::Session;
use zenoh::sample::{Sample, SampleKind};

use super::events::{Event, Events};

/// Zenoh takes five seconds to remove the token of a learner that lost its connection, and longer
/// on a busy machine.
const PATIENCE: Duration = Duration::from_secs(20);
/// For this long after its start, a learner ends if it sees an earlier learner of the same name. By
/// then the tokens of learners that started together have arrived.
const TOGETHER: Duration = Duration::from_secs(10);
/// How often the learner looks for another one, and how long an answer may take.
const LOOK_AGAIN: Duration = Duration::from_millis(500);

/// Identifies one process of a run's learner.
#[derive(Clone, Debug)]
pub(crate) struct Incarnation {
    pub run: Name,
    /// The start of this process: a later start has a larger number.
    pub number: u64,
}

/// Returns when no other learner of the run is connected.
///
/// # Errors
///
/// Another learner is still connected when the token of a dead one would be gone.
pub(super) async fn wait_until_gone(
    session: &Session,
    incarnation: &Incarnation,
) -> anyhow::Result<()> {
    let deadline = Instant::now() + PATIENCE;
    let mut said = false;
    while let Some(other) = another(session, incarnation).await? {
        if Instant::now() >= deadline {
            return Err(is_there(incarnation, other));
        }
        if !said {
            info!(
                "another learner of run {} was here a moment ago; waiting to see if it is gone",
                incarnation.run
            );
            said = true;
        }
        tokio::time::sleep(LOOK_AGAIN).await;
    }
    Ok(())
}

async fn another(session: &Session, incarnation: &Incarnation) -> anyhow::Result<Option<u64>> {
    let asked = session
        .liveliness()
        .get(keys::all_incarnations(&incarnation.run))
        .timeout(LOOK_AGAIN)
        .await;
    let replies = asked.map_err(anyhow::Error::from_boxed)?;
    while let Ok(reply) = replies.recv_async().await {
        let found =
            reply.result().ok().and_then(|token| keys::incarnation_of(token.key_expr().as_str()));
        if let Some(other) = found.filter(|other| *other != incarnation.number) {
            return Ok(Some(other));
        }
    }
    Ok(None)
}

/// Ends the run if a learner appears that started a little earlier. (A later learner stops by
/// itself.)
pub(super) async fn watch(
    session: &Session,
    incarnation: &Incarnation,
    events: &Events,
) -> anyhow::Result<()> {
    let (mine, events, told) = (incarnation.clone(), events.clone(), AtomicBool::new(false));
    let callback = move |token: Sample| {
        let there = token.kind() == SampleKind::Put;
        let found = keys::incarnation_of(token.key_expr().as_str());
        let earlier = found.filter(|other| there && *other < mine.number);
        if let Some(other) = earlier
            && !told.swap(true, Ordering::Relaxed)
        {
            events.send(Event::Failed(is_there(&mine, other))).ok();
        }
    };
    let tokens = session
        .liveliness()
        .declare_subscriber(keys::all_incarnations(&incarnation.run))
        .history(true)
        .callback(callback);
    let tokens = tokens.await.map_err(anyhow::Error::from_boxed)?;
    tokio::spawn(async move {
        tokio::time::sleep(TOGETHER).await;
        if let Err(error) = tokens.undeclare().await {
            debug!(%error, "learners' tokens are still received");
        }
    });
    Ok(())
}

fn is_there(incarnation: &Incarnation, other: u64) -> anyhow::Error {
    let error = anyhow!(
        "there is another learner of run {} (incarnation {other}, this one is {})",
        incarnation.run,
        incarnation.number
    );
    hinted(error, "choose another name for the folder with --run-dir, or stop the other learner")
}
