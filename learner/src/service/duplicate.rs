//! Two learners of one run name would answer each other's evaluators. The second one stops.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::anyhow;
use quad_protocol::{Name, keys};
use quad_service::hinted;
use tracing::{debug, info};
use zenoh::Session;
use zenoh::sample::{Sample, SampleKind};

use super::events::{Event, Events};

/// The token of a learner that was cut off lasts for as long as Zenoh takes to notice: five seconds.
const PATIENCE: Duration = Duration::from_secs(8);
/// So long after the start an earlier learner of the name ends this one: tokens of learners that start together have
/// arrived by then.
const TOGETHER: Duration = Duration::from_secs(10);
/// How often it is looked for meanwhile, and how long an answer may take.
const LOOK_AGAIN: Duration = Duration::from_millis(500);

/// Which life of which run's learner this is.
#[derive(Clone, Debug)]
pub(crate) struct Life {
    pub run: Name,
    /// Which start of its learner: a later one has a larger number.
    pub incarnation: u64,
}

/// Returns when no other learner of the run is there.
///
/// # Errors
///
/// One is still there when a dead one's token would have gone.
pub(super) async fn wait_until_gone(session: &Session, life: &Life) -> anyhow::Result<()> {
    let deadline = Instant::now() + PATIENCE;
    let mut said = false;
    while let Some(other) = another(session, life).await? {
        if Instant::now() >= deadline {
            return Err(is_there(life, other));
        }
        if !said {
            info!("another learner of run {} was here a moment ago; waiting to see if it is gone", life.run);
            said = true;
        }
        tokio::time::sleep(LOOK_AGAIN).await;
    }
    Ok(())
}

async fn another(session: &Session, life: &Life) -> anyhow::Result<Option<u64>> {
    let asked = session.liveliness().get(keys::all_lives(&life.run)).timeout(LOOK_AGAIN).await;
    let replies = asked.map_err(anyhow::Error::from_boxed)?;
    while let Ok(reply) = replies.recv_async().await {
        let found = reply.result().ok().and_then(|token| keys::incarnation_of(token.key_expr().as_str()));
        if let Some(other) = found.filter(|other| *other != life.incarnation) {
            return Ok(Some(other));
        }
    }
    Ok(None)
}

/// Ends the run when a learner shows up soon that was started a little earlier. (A later one stops by itself.)
pub(super) async fn watch(session: &Session, life: &Life, events: &Events) -> anyhow::Result<()> {
    let (mine, events, told) = (life.clone(), events.clone(), AtomicBool::new(false));
    let callback = move |token: Sample| {
        let there = token.kind() == SampleKind::Put;
        let found = keys::incarnation_of(token.key_expr().as_str());
        let earlier = found.filter(|other| there && *other < mine.incarnation);
        if let Some(other) = earlier
            && !told.swap(true, Ordering::Relaxed)
        {
            events.send(Event::Failed(is_there(&mine, other))).ok();
        }
    };
    let tokens = session.liveliness().declare_subscriber(keys::all_lives(&life.run)).history(true).callback(callback);
    let tokens = tokens.await.map_err(anyhow::Error::from_boxed)?;
    tokio::spawn(async move {
        tokio::time::sleep(TOGETHER).await;
        if let Err(error) = tokens.undeclare().await {
            debug!(%error, "learners' tokens go on to be received");
        }
    });
    Ok(())
}

fn is_there(life: &Life, other: u64) -> anyhow::Error {
    let error =
        anyhow!("there is another learner of run {} (incarnation {other}, this one is {})", life.run, life.incarnation);
    hinted(error, "choose another name for the folder with --run-dir, or stop the other learner")
}
