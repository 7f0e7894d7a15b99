//! Keeps the newest snapshot that a run's learner published.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use quad_protocol::{Job, Message, Name, Snapshot, decode_from, keys};
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tracing::{debug, warn};
use zenoh::Session;
use zenoh::bytes::ZBytes;
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;

use super::budget::{Budget, Share};
use crate::metrics::Metrics;

/// The newest good snapshot that one run's learner published while this evaluator listened.
pub struct SnapshotReceiver {
    shared: Arc<Shared>,
    _subscriber: Subscriber<()>,
    // Aborted with the receiver.
    _decoder: JoinSet<()>,
}

#[derive(Default)]
struct Shared {
    /// As it came; the next one takes its place.
    arrived: Mutex<Option<(ZBytes, Share)>>,
    to_decode: Notify,
    newest: Mutex<Option<(Arc<Snapshot>, Share)>>,
    /// Whose snapshots are kept.
    incarnation: AtomicU64,
    is_new: AtomicBool,
    /// One bad snapshot is a line in the log; all are counted.
    warned: AtomicBool,
}

impl SnapshotReceiver {
    /// Listens to `quad/<run>/weights`; `arrived` is told of each good snapshot of the [followed](Self::follow) learner.
    /// Those for which `budget` has no room are not kept; they can be asked for.
    pub async fn listen(
        session: &Session,
        run: Name,
        metrics: Metrics,
        arrived: Arc<Notify>,
        budget: Budget,
    ) -> zenoh::Result<SnapshotReceiver> {
        let shared = Arc::new(Shared::default());
        let (slot, counted) = (shared.clone(), metrics.clone());
        // Newest wins: a queue would hold snapshots nobody wants, and a full one stops the whole session.
        let callback = move |sample: Sample| {
            let payload = sample.payload();
            if payload.len() > Snapshot::LIMIT {
                return counted.rejected("oversized");
            }
            // The one that waited makes room first. Twice: as it came, and decoded.
            *lock(&slot.arrived) = None;
            match budget.take(2 * payload.len()) {
                Some(share) => *lock(&slot.arrived) = Some((payload.clone(), share)),
                None => return counted.rejected("no_room"),
            }
            slot.to_decode.notify_one();
        };
        let subscriber = session.declare_subscriber(keys::weights(&run)).callback(callback).await?;
        let mut decoder = JoinSet::new();
        decoder.spawn(decode_all(shared.clone(), run, metrics, arrived));
        Ok(SnapshotReceiver { shared, _subscriber: subscriber, _decoder: decoder })
    }

    /// Keeps only what this life of the learner publishes.
    pub fn follow(&self, incarnation: u64) {
        self.shared.incarnation.store(incarnation, Relaxed);
    }

    /// Whether a snapshot has come since this was last asked.
    pub fn take_news(&self) -> bool {
        self.shared.is_new.swap(false, Relaxed)
    }

    /// The snapshot that `job` names, if it is the newest. The same step of another incarnation does not count.
    pub fn get(&self, job: &Job) -> Option<Arc<Snapshot>> {
        let newest = lock(&self.shared.newest);
        let snapshot = newest.as_ref().map(|(snapshot, _)| snapshot)?;
        let named = (snapshot.incarnation, snapshot.step, snapshot.hash) == (job.incarnation, job.step, job.weights);
        named.then(|| snapshot.clone())
    }
}

async fn decode_all(shared: Arc<Shared>, run: Name, metrics: Metrics, arrived: Arc<Notify>) {
    loop {
        shared.to_decode.notified().await;
        let Some((payload, share)) = lock(&shared.arrived).take() else { continue };
        // Hashing megabytes is work for a thread of its own, not for the runtime's.
        let decoding = tokio::task::spawn_blocking(move || decode_from::<Snapshot>(payload.len(), payload.reader()));
        let problem = match decoding.await {
            Ok(Ok(snapshot)) if snapshot.run != run => {
                metrics.rejected("other_run");
                "it is of another run".to_owned()
            }
            Ok(Ok(snapshot)) if snapshot.incarnation != shared.incarnation.load(Relaxed) => {
                metrics.rejected("other_incarnation");
                "it is from another learner than the one that is followed".to_owned()
            }
            Ok(Ok(snapshot)) => {
                metrics.snapshots_received.inc();
                debug!(%run, step = snapshot.step, "weights arrived");
                *lock(&shared.newest) = Some((Arc::new(snapshot), share));
                shared.is_new.store(true, Relaxed);
                arrived.notify_one();
                continue;
            }
            Ok(Err(error)) => {
                metrics.rejected(error.label());
                error.to_string()
            }
            Err(error) => error.to_string(),
        };
        match shared.warned.swap(true, Relaxed) {
            false => warn!(%run, "ignored what was published as weights (others will only be counted): {problem}"),
            true => debug!(%run, "ignored what was published as weights: {problem}"),
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
