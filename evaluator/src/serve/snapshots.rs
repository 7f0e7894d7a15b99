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

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use quad_protocol::{Hash, Schema, encode};
    use quad_service::{Endpoints, open_session};

    use super::*;

    const BYTES: usize = 100_000;

    fn snapshot(run: &Name, step: u64) -> Vec<u8> {
        let schema = Schema {
            environment: "hopper".to_owned(),
            observation_dim: 11,
            action_dim: 3,
            policy: "diffusion".to_owned(),
        };
        let tensors = vec![step as u8; BYTES];
        encode(&Snapshot { run: run.clone(), incarnation: 1, step, schema, hash: Hash::of(&tensors), tensors }).unwrap()
    }

    async fn eventually(what: &str, held: impl Fn() -> bool) {
        let wait = async {
            while !held() {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(Duration::from_secs(20), wait).await.unwrap_or_else(|_| panic!("{what}"));
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn runs_share_the_memory_for_what_they_publish() {
        let endpoints = Endpoints { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..Endpoints::default() };
        let session = open_session(&endpoints).await.unwrap();
        let (metrics, arrived) = (Metrics::new().unwrap(), Arc::new(Notify::new()));
        let [one, other] = ["one", "other"].map(|name| Name::new(name).unwrap());
        // A snapshot that is kept, and the next one of the same run.
        let budget = Budget::new(2 * 2 * (BYTES + 1000));
        let listen = |run: &Name| {
            SnapshotReceiver::listen(&session, run.clone(), metrics.clone(), arrived.clone(), budget.clone())
        };
        let (first, second) = (listen(&one).await.unwrap(), listen(&other).await.unwrap());
        let step_of = |receiver: &SnapshotReceiver| {
            let newest = lock(&receiver.shared.newest);
            newest.as_ref().map(|(snapshot, _)| snapshot.step)
        };
        first.follow(1);
        second.follow(1);
        for step in 1..5 {
            session.put(keys::weights(&one), snapshot(&one, step)).await.unwrap();
            eventually("the newest takes the place of the one before", || step_of(&first) == Some(step)).await;
        }
        let large = vec![0; 2 * BYTES];
        session.put(keys::weights(&other), large.clone()).await.unwrap();
        let no_room = || metrics.counted("no_room");
        eventually("there is no room for two more", || no_room() == 1).await;
        session.put(keys::weights(&other), snapshot(&other, 7)).await.unwrap();
        eventually("there is for one", || step_of(&second) == Some(7)).await;
        session.put(keys::weights(&one), snapshot(&one, 5)).await.unwrap();
        eventually("and then for no more", || no_room() == 2).await;
        assert_eq!(step_of(&first), Some(4), "it is kept");
        drop(second);
        eventually("who goes gives back what was taken", || budget.take(2 * (BYTES + 1000)).is_some()).await;
        session.put(keys::weights(&one), snapshot(&one, 6)).await.unwrap();
        eventually("there is room again", || step_of(&first) == Some(6)).await;
    }
}
