//! The liveliness tokens of those evaluators that the hub wants to follow.

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, Sender, channel};

use quad_protocol::{Name, keys};
use quad_service::stay_in_background;
use tracing::debug;
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use crate::hub::{self, Follow};
use crate::inbox::Inbox;
use crate::metrics::Metrics;
use crate::threads::spawn_for_hub;

/// Starts a thread that tells of those evaluators that it is told to follow, until nobody can tell it any more. Zenoh can let
/// it wait for seconds.
pub(super) fn follower(
    session: &Session,
    run: &Name,
    hub: &Inbox<hub::Event>,
    metrics: &Metrics,
) -> std::io::Result<Sender<Follow>> {
    let (sender, wanted) = channel();
    let (session, run, hub, metrics) = (session.clone(), run.clone(), hub.clone(), metrics.clone());
    spawn_for_hub("follower", &hub.clone(), move || follow(&session, &run, &hub, &metrics, &wanted))?;
    Ok(sender)
}

fn follow(session: &Session, run: &Name, hub: &Inbox<hub::Event>, metrics: &Metrics, wanted: &Receiver<Follow>) {
    stay_in_background();
    let mut followed = BTreeMap::new();
    for change in wanted {
        match change {
            Follow::Begin(evaluator) => {
                let (hub, metrics, name) = (hub.clone(), metrics.clone(), evaluator.clone());
                let tell = move |token: Sample| {
                    let change = match token.kind() {
                        SampleKind::Put => hub::Event::Joined(name.clone()),
                        SampleKind::Delete => hub::Event::Left(name.clone()),
                    };
                    // The hub asks again for whoever it has not heard of for a while.
                    if hub.offer_change(change).is_err() {
                        metrics.reject("busy");
                    }
                };
                // The old one goes first: another one beside it would not be told what it has been told.
                drop(followed.remove(&evaluator));
                let key = keys::live_evaluator(run, &evaluator);
                match session.liveliness().declare_subscriber(key).history(true).callback(tell).wait() {
                    Ok(tokens) => drop(followed.insert(evaluator, tokens)),
                    Err(error) => debug!(%error, %evaluator, "cannot be followed"),
                }
            }
            Follow::End(evaluator) => drop(followed.remove(&evaluator)),
        }
    }
}
