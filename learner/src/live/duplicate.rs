//! Two learners with one run name would answer each other's evaluators, so the second learner
//! stops.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::anyhow;
use quad_protocol::{Name, keys};
use quad_runtime::hinted;
use tracing::info;
use zenoh::Session;
use zenoh::sample::{Sample, SampleKind};

use super::events::{Event, Events};

/// Zenoh takes five seconds to remove the token of a learner that lost its connection, and longer
/// on a busy machine.
const PATIENCE: Duration = Duration::from_secs(20);
/// A learner of this age no longer ends if it sees an earlier one of the same name: the tokens of
/// learners that started together have arrived.
const TOGETHER: Duration = Duration::from_secs(10);
/// Interval of the searches for another learner, and time limit of each.
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
/// Another learner is still connected when the token of a dead one would be gone.
pub(super) async fn wait_until_gone(
    session: &Session,
    incarnation: &Incarnation,
) -> anyhow::Result<()> {
    let deadline = Instant::now() + PATIENCE;
    let mut logged = false;
    while let Some(other) = another(session, incarnation).await? {
        if Instant::now() >= deadline {
            return Err(conflict(incarnation, other));
        }
        if !logged {
            let run = &incarnation.run;
            info!(
                "another learner of run {run} was here a moment ago; waiting to see if it is gone"
            );
            logged = true;
        }
        tokio::time::sleep(LOOK_AGAIN).await;
    }
    Ok(())
}

async fn another(session: &Session, incarnation: &Incarnation) -> anyhow::Result<Option<u64>> {
    let liveliness = session.liveliness();
    let query = liveliness.get(keys::live_learner(&incarnation.run, keys::ANY)).timeout(LOOK_AGAIN);
    let replies = query.await.map_err(anyhow::Error::from_boxed)?;
    while let Ok(reply) = replies.recv_async().await {
        let number =
            reply.result().ok().and_then(|token| keys::incarnation_of(token.key_expr().as_str()));
        if let Some(other) = number.filter(|other| *other != incarnation.number) {
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
    let (mine, events, reported) = (incarnation.clone(), events.clone(), AtomicBool::new(false));
    let begin = Instant::now();
    let callback = move |token: Sample| {
        if let Some(other) = keys::incarnation_of(token.key_expr().as_str())
            && token.kind() == SampleKind::Put
            && other < mine.number
            && begin.elapsed() < TOGETHER
            && !reported.swap(true, Ordering::Relaxed)
        {
            events.send(Event::Failed(conflict(&mine, other)));
        }
    };
    let liveliness = session.liveliness();
    let tokens = liveliness
        .declare_subscriber(keys::live_learner(&incarnation.run, keys::ANY))
        .history(true)
        .callback(callback);
    tokens.background().await.map_err(anyhow::Error::from_boxed)
}

fn conflict(Incarnation { run, number }: &Incarnation, other: u64) -> anyhow::Error {
    let error = anyhow!(
        "there is another learner of run {run} (incarnation {other}, this one is {number})"
    );
    hinted(error, "choose another name for the folder with --run-dir, or stop the other learner")
}
