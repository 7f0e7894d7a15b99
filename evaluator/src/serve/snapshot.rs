//! Keeps the newest snapshots. Each published snapshot is decoded and verified once, on arrival.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use quad_protocol::{Job, Name, Snapshot, decode_from, keys};
use tokio::sync::Notify;
use tracing::{debug, warn};
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use super::connection::{blocking, is_named_by};
use super::discovery::RunKey;
use crate::metrics::Metrics;

/// Most bytes of kept snapshots, over all runs. The largest allowed snapshot fits.
const MAX_BYTES: usize = 256 << 20;
/// Label of a snapshot from a learner process that is not followed. It is no fault: after a restart,
/// the new process is followed when the current job is done.
const OTHER_INCARNATION: &str = "other_incarnation";

type Kept = VecDeque<(RunKey, Arc<Snapshot>)>;

/// The newest snapshot of each run, as far as memory allows. Clones share them.
#[derive(Clone, Default)]
pub struct Snapshots {
    /// In the order of arrival.
    kept: Arc<Mutex<Kept>>,
    arrived: Arc<Notify>,
}

impl Snapshots {
    /// Replaces the run's last snapshot. If memory is short, drops the oldest ones.
    fn keep(&self, run: &RunKey, snapshot: Snapshot) {
        self.forget(run);
        let mut kept = self.lock();
        kept.push_back((run.clone(), Arc::new(snapshot)));
        let mut bytes: usize = kept.iter().map(|(_, kept)| kept.file.len()).sum();
        while bytes > MAX_BYTES {
            bytes -= kept.pop_front().map_or(0, |(_, oldest)| oldest.file.len());
        }
        drop(kept);
        self.arrived.notify_one();
    }

    pub fn forget(&self, run: &RunKey) {
        self.lock().retain(|(kept, _)| kept != run);
    }

    pub fn get(&self, run: &RunKey, job: &Job) -> Option<Arc<Snapshot>> {
        let kept = self.lock();
        let named = kept.iter().find(|(owner, kept)| owner == run && is_named_by(job, kept));
        named.map(|(_, kept)| kept.clone())
    }

    /// Waits for the next snapshot of any run.
    pub async fn arrival(&self) {
        self.arrived.notified().await;
    }

    fn lock(&self) -> MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A subscription to the snapshots of one run's learner.
pub struct Listener {
    inbox: Arc<Inbox>,
    _subscriber: Subscriber<()>,
}

#[derive(Default)]
struct Inbox {
    /// The followed learner process.
    incarnation: AtomicU64,
    has_news: AtomicBool,
    /// True after the first warning about a bad snapshot; further ones are only counted.
    warned: AtomicBool,
}

impl Listener {
    /// Subscribes to the run's `quad/<run>/weights` and keeps the snapshots of the [followed](Self::follow)
    /// learner in `snapshots`.
    ///
    /// Zenoh's receiving thread also decodes and verifies, for milliseconds in which it receives no
    /// other message.
    pub async fn start(
        session: &Session,
        key: RunKey,
        snapshots: Snapshots,
        metrics: Metrics,
    ) -> anyhow::Result<Listener> {
        let inbox = Arc::new(Inbox::default());
        let (session, weights, shared) = (session.clone(), keys::weights(&key.1), inbox.clone());
        let callback = move |sample: Sample| match read(&sample, &key.1, &shared) {
            Ok(snapshot) => {
                metrics.snapshots_received.inc();
                debug!(run = %key.1, step = snapshot.step, "weights arrived");
                shared.has_news.store(true, Relaxed);
                snapshots.keep(&key, snapshot);
            }
            Err((label, problem)) => {
                metrics.rejected(label);
                if label != OTHER_INCARNATION && !shared.warned.swap(true, Relaxed) {
                    warn!(run = %key.1, "ignored a bad snapshot (further ones are only counted): {problem}");
                }
            }
        };
        let declare = move || session.declare_subscriber(weights).callback(callback).wait();
        let _subscriber = blocking(declare).await?;
        Ok(Listener { inbox, _subscriber })
    }

    /// Keeps only the snapshots of this learner process from now on.
    pub fn follow(&self, incarnation: u64) {
        self.inbox.incarnation.store(incarnation, Relaxed);
    }

    /// Returns whether a snapshot has come since the last call.
    pub fn take_news(&self) -> bool {
        self.inbox.has_news.swap(false, Relaxed)
    }
}

/// Decodes a snapshot of the followed learner. An error has the label of the reason.
fn read(sample: &Sample, run: &Name, inbox: &Inbox) -> Result<Snapshot, (&'static str, String)> {
    let payload = sample.payload();
    let snapshot: Snapshot = decode_from(payload.len(), payload.reader())
        .map_err(|error| (error.label(), error.to_string()))?;
    if snapshot.run != *run {
        return Err(("other_run", format!("it is of run {}", snapshot.run)));
    }
    if snapshot.incarnation != inbox.incarnation.load(Relaxed) {
        let problem = "it is from another learner process".to_owned();
        return Err((OTHER_INCARNATION, problem));
    }
    Ok(snapshot)
}

#[cfg(test)]
mod tests {
    use quad_protocol::Hash;

    use super::super::fixtures::{job, snapshot};
    use super::*;

    #[test]
    fn keeps_the_newest_snapshot_of_each_run_within_the_memory_limit() {
        let snapshots = Snapshots::default();
        let key = |endpoint, run: &str| (endpoint, Name::new(run).unwrap());
        let keep = |endpoint, run: &str, step, bytes| {
            snapshots.keep(&key(endpoint, run), Snapshot { step, ..snapshot(vec![0; bytes]) });
            Vec::from_iter(snapshots.lock().iter().map(|(_, kept)| kept.step))
        };
        assert_eq!(keep(0, "one", 1, MAX_BYTES / 3), [1]);
        // Another learner's run of the name.
        assert_eq!(keep(1, "one", 2, MAX_BYTES / 3), [1, 2]);
        // It replaces the run's last one.
        assert_eq!(keep(0, "one", 3, MAX_BYTES / 3), [2, 3]);
        // The oldest makes room.
        assert_eq!(keep(0, "large", 4, MAX_BYTES / 2), [3, 4]);
        snapshots.forget(&key(1, "one"));
        snapshots.forget(&key(0, "one"));
        assert_eq!(keep(0, "large", 5, 0), [5]);
    }

    #[test]
    fn a_job_gets_exactly_the_snapshot_that_it_names() {
        let snapshots = Snapshots::default();
        let run = (0, job().run);
        snapshots.keep(&run, snapshot(b"policy".to_vec()));
        let named = Job { weights: Hash::new(b"policy"), ..job() };
        assert!(snapshots.get(&run, &named).is_some());
        assert!(snapshots.get(&(1, job().run), &named).is_none());
        let changes: [fn(&mut Job); 4] = [
            |job| job.run = Name::new("other").unwrap(),
            |job| job.incarnation = 2,
            |job| job.step = 8,
            |job| job.weights = Hash::new(b"others"),
        ];
        for change in changes {
            let mut other = named.clone();
            change(&mut other);
            assert!(snapshots.get(&run, &other).is_none(), "{other:?}");
        }
    }
}
