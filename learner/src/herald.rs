//! The thread that publishes: weights for evaluators, recorded scores for whoever watches.
//!
//! A subscriber that does not read lets Zenoh wait for him, half a second or more with each message, so no thread that others
//! wait for publishes by itself. What waits here is bounded: the newest weights, and some scores. Nothing depends on any of it:
//! evaluators ask for weights that they have missed.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use quad_service::stay_in_background;
use tracing::debug;
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

use crate::hub;
use crate::inbox::Inbox;
use crate::threads::spawn_for_hub;

/// Most messages with scores that wait; later ones are left out.
const MOST_SCORES: usize = 256;

/// A key and what is published there.
type Message = (String, ZBytes);

#[derive(Debug, Default)]
struct Waiting {
    weights: Option<Message>,
    scores: VecDeque<Message>,
    closed: bool,
}

#[derive(Debug, Default)]
struct Shared {
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

/// Reaches the thread, which ends when the last clone is dropped.
#[derive(Clone, Debug)]
pub struct Herald {
    shared: Arc<Shared>,
    _last: Arc<CloseOnDrop>,
}

#[derive(Debug)]
struct CloseOnDrop(Arc<Shared>);

impl Drop for CloseOnDrop {
    fn drop(&mut self) {
        self.0.lock().closed = true;
        self.0.changed.notify_one();
    }
}

impl Herald {
    /// Starts the thread. If it panics, the hub is told that the run cannot go on.
    pub fn start(session: &Session, hub: &Inbox<hub::Event>) -> std::io::Result<Self> {
        let shared = Arc::new(Shared::default());
        let (session, work) = (session.clone(), shared.clone());
        spawn_for_hub("herald", hub, move || work.publish_all(&session))?;
        Ok(Self { _last: Arc::new(CloseOnDrop(shared.clone())), shared })
    }

    /// Publishes weights, in place of those that still wait.
    pub fn weights(&self, key: String, message: ZBytes) {
        self.shared.lock().weights = Some((key, message));
        self.shared.changed.notify_one();
    }

    /// Publishes scores, unless too many wait.
    pub fn scores(&self, key: String, message: Vec<u8>) {
        let mut waiting = self.shared.lock();
        if waiting.scores.len() < MOST_SCORES {
            waiting.scores.push_back((key, message.into()));
            self.shared.changed.notify_one();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn publish_all(&self, session: &Session) {
        stay_in_background();
        while let Some((key, message)) = self.next() {
            // Without a Zenoh publisher, which a router would tell of every subscription that fits: strangers can make up many.
            let put = session.put(&key, message).congestion_control(CongestionControl::Drop);
            if let Err(error) = put.wait() {
                debug!(%error, key, "could not be published");
            }
        }
    }

    /// Weights go first: evaluators wait for them.
    fn next(&self) -> Option<Message> {
        let mut waiting = self.lock();
        loop {
            if let Some(message) = waiting.weights.take().or_else(|| waiting.scores.pop_front()) {
                return Some(message);
            }
            if waiting.closed {
                return None;
            }
            waiting = self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
    }
}
