//! Evaluators' liveliness tokens: all of them at a learner that listens, where floods can be held back, and behind a router
//! those that the hub wants to follow.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread;

use quad_protocol::{Name, keys};
use quad_service::stay_in_background;
use tracing::debug;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use super::flood::FloodGuard;
use super::zenoh_error;
use crate::hub::{self, Follow};
use crate::inbox::Inbox;
use crate::metrics::Metrics;

/// Where who comes and goes is told.
#[derive(Clone)]
pub(super) struct Changes {
    pub hub: Inbox<hub::Event>,
    pub metrics: Metrics,
    pub flood: Arc<FloodGuard>,
}

impl Changes {
    fn take_in(&self, token: &Sample) {
        // Who leaves has come before; and all of a connection's leave at its end, not in its task.
        if token.kind() == SampleKind::Put {
            self.flood.message();
        }
        let Some(evaluator) = keys::evaluator_of(token.key_expr().as_str()) else {
            return self.metrics.reject("invalid_name");
        };
        let change = match token.kind() {
            SampleKind::Put => hub::Event::Joined(evaluator),
            SampleKind::Delete => hub::Event::Left(evaluator),
        };
        // What is lost here is a name in the display, or a job that waits for the end of its lease.
        if self.hub.offer_change(change).is_err() {
            self.metrics.reject("busy");
        }
    }
}

/// Tells of every evaluator of the run.
pub(super) async fn all(session: &Session, run: &Name, changes: Changes) -> anyhow::Result<Subscriber<()>> {
    let tokens = session.liveliness().declare_subscriber(keys::all_evaluators(run)).history(true);
    tokens.callback(move |token| changes.take_in(&token)).await.map_err(zenoh_error)
}

/// Starts a thread that tells of those evaluators that it is told to follow, until nobody can tell it any more. Zenoh can let
/// it wait for seconds.
pub(super) fn follower(session: &Session, run: &Name, changes: Changes) -> std::io::Result<Sender<Follow>> {
    let (sender, wanted) = channel();
    let (session, run) = (session.clone(), run.clone());
    thread::Builder::new().name("follower".to_owned()).spawn(move || follow(&session, &run, &changes, &wanted))?;
    Ok(sender)
}

fn follow(session: &Session, run: &Name, changes: &Changes, wanted: &Receiver<Follow>) {
    stay_in_background();
    let mut followed = BTreeMap::new();
    for change in wanted {
        match change {
            Follow::Begin(evaluator) => {
                let changes = changes.clone();
                let tokens =
                    session.liveliness().declare_subscriber(keys::live_evaluator(run, &evaluator)).history(true);
                match tokens.callback(move |token| changes.take_in(&token)).wait() {
                    Ok(tokens) => drop(followed.insert(evaluator, tokens)),
                    Err(error) => debug!(%error, %evaluator, "cannot be followed"),
                }
            }
            Follow::End(evaluator) => drop(followed.remove(&evaluator)),
        }
    }
}
