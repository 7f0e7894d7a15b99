//! Keeps the newest snapshots. Each published snapshot is decoded and verified once, when it
//! arrives.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use quad_protocol::{Job, Name, Snapshot, decode_from, keys};
use tokio::sync::Notify;
use tracing::{debug, warn};
use zenoh::pubsub::Subscriber;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use super::query::may_block;
use crate::metrics::Metrics;

/// Most memory for kept snapshots, of all runs together, bytes; the largest allowed snapshot fits.
const MOST_BYTES: usize = 256 << 20;

/// Whether `snapshot` is the one that `job` names. Decoding has verified its hash.
pub fn is_named_by(job: &Job, snapshot: &Snapshot) -> bool {
    let named = (&job.run, job.incarnation, job.step, job.weights);
    named == (&snapshot.run, snapshot.incarnation, snapshot.step, snapshot.hash)
}

/// The newest snapshot of each run, as far as memory allows. Clones share them.
#[derive(Clone, Default)]
pub struct Snapshots {
    /// Snapshots in the order of arrival.
    kept: Arc<Mutex<VecDeque<Arc<Snapshot>>>>,
    arrived: Arc<Notify>,
}

impl Snapshots {
    /// Keeps a snapshot in place of the run's last one. If memory is short, drops the oldest.
    fn keep(&self, snapshot: Snapshot) {
        self.forget(&snapshot.run);
        let mut kept = self.lock();
        kept.push_back(Arc::new(snapshot));
        while kept.iter().map(|snapshot| snapshot.file.len()).sum::<usize>() > MOST_BYTES {
            kept.pop_front();
        }
        drop(kept);
        self.arrived.notify_one();
    }

    /// Drops the snapshot of a run.
    pub fn forget(&self, run: &Name) {
        self.lock().retain(|snapshot| snapshot.run != *run);
    }

    /// The snapshot that `job` names, if it is kept.
    pub fn get(&self, job: &Job) -> Option<Arc<Snapshot>> {
        self.lock().iter().find(|snapshot| is_named_by(job, snapshot)).cloned()
    }

    /// Waits for the next snapshot of any run.
    pub async fn arrival(&self) {
        self.arrived.notified().await;
    }

    fn lock(&self) -> MutexGuard<'_, VecDeque<Arc<Snapshot>>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Receives the snapshots of one run's learner as long as it lives.
pub struct Listener {
    state: Arc<State>,
    _subscriber: Subscriber<()>,
}

#[derive(Default)]
struct State {
    /// The learner whose snapshots are kept.
    incarnation: AtomicU64,
    has_news: AtomicBool,
    /// Whether a bad snapshot was logged as a warning; further ones are only counted.
    warned: AtomicBool,
}

impl Listener {
    /// Subscribes to `quad/<run>/weights` and puts the snapshots of the [followed](Self::follow)
    /// learner into `snapshots`.
    ///
    /// Zenoh's receiving thread also decodes and verifies: that takes milliseconds, in which it
    /// receives no other message.
    pub async fn start(
        session: &Session,
        run: Name,
        snapshots: Snapshots,
        metrics: Metrics,
    ) -> anyhow::Result<Listener> {
        let state = Arc::new(State::default());
        let (session, key, shared) = (session.clone(), keys::weights(&run), state.clone());
        let callback = move |sample: Sample| match read(&sample, &run, &shared) {
            Ok(snapshot) => {
                metrics.snapshots_received.inc();
                debug!(%run, step = snapshot.step, "weights arrived");
                shared.has_news.store(true, Relaxed);
                snapshots.keep(snapshot);
            }
            Err((label, problem)) => {
                metrics.rejected(label);
                match shared.warned.swap(true, Relaxed) {
                    false => {
                        warn!(%run, "ignored what was published as weights (the next such will only be counted): {problem}");
                    }
                    true => debug!(%run, "ignored what was published as weights: {problem}"),
                }
            }
        };
        let declare = move || session.declare_subscriber(key).callback(callback).wait();
        Ok(Listener { state, _subscriber: may_block(declare).await? })
    }

    /// Keeps only the snapshots of this incarnation of the learner from now on.
    pub fn follow(&self, incarnation: u64) {
        self.state.incarnation.store(incarnation, Relaxed);
    }

    /// Whether a snapshot has come since the last call.
    pub fn take_news(&self) -> bool {
        self.state.has_news.swap(false, Relaxed)
    }
}

/// Decodes a snapshot of the followed learner; on failure returns the label of the reason, and a
/// message.
fn read(sample: &Sample, run: &Name, state: &State) -> Result<Snapshot, (&'static str, String)> {
    let payload = sample.payload();
    let snapshot: Snapshot = decode_from(payload.len(), payload.reader())
        .map_err(|error| (error.label(), error.to_string()))?;
    if snapshot.run != *run {
        return Err(("other_run", format!("it is of run {}", snapshot.run)));
    }
    if snapshot.incarnation != state.incarnation.load(Relaxed) {
        return Err((
            "other_incarnation",
            "it is from another learner than the one that is followed".to_owned(),
        ));
    }
    Ok(snapshot)
}

#[cfg(test)]
mod tests {
    use quad_protocol::Hash;

    use super::super::fixtures::{job, snapshot};
    use super::*;

    #[test]
    fn the_newest_of_each_run_is_kept_as_long_as_there_is_memory() {
        let snapshots = Snapshots::default();
        let keep = |run: &str, step, bytes| {
            let run = Name::new(run).unwrap();
            snapshots.keep(Snapshot { run, step, file: vec![0; bytes], ..snapshot(Vec::new()) });
            snapshots.lock().iter().map(|snapshot| snapshot.step).collect::<Vec<u64>>()
        };
        assert_eq!(keep("one", 1, MOST_BYTES / 3), [1]);
        assert_eq!(keep("other", 2, MOST_BYTES / 3), [1, 2]);
        assert_eq!(keep("one", 3, MOST_BYTES / 3), [2, 3], "it takes the place of the one before");
        assert_eq!(keep("large", 4, MOST_BYTES / 2), [3, 4], "the one that came first makes room");
        snapshots.forget(&Name::new("one").unwrap());
        assert_eq!(keep("large", 5, 0), [5]);
    }

    #[test]
    fn a_job_gets_exactly_the_snapshot_that_it_names() {
        let snapshots = Snapshots::default();
        snapshots.keep(snapshot(b"policy".to_vec()));
        let job = Job { weights: Hash::of(b"policy"), ..job() };
        assert!(snapshots.get(&job).is_some());
        for other in [
            Job { run: Name::new("other").unwrap(), ..job.clone() },
            Job { incarnation: 2, ..job.clone() },
            Job { step: 8, ..job.clone() },
            Job { weights: Hash::of(b"others"), ..job.clone() },
        ] {
            assert!(snapshots.get(&other).is_none(), "{other:?}");
        }
    }
}
