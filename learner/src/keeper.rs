//! The thread that keeps the training's results on disk: each snapshot, and the newest checkpoint.
//!
//! A disk that is full or hangs delays this thread alone. It tries again until the disk takes what waits, so nothing is
//! lost by it. What waits is bounded: of checkpoints the newest, of snapshots so many bytes that a training has to go on
//! for hours before it waits for the disk, too.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use quad_dataset::Task;
use quad_protocol::{Hash, Origin};
use quad_service::Beat;
use tokio::sync::mpsc::UnboundedSender;
use tracing::debug;

use crate::hub::{EvaluationPlan, other_weights};
use crate::inbox::Inbox;
use crate::metrics::Metrics;
use crate::notice::Notice;
use crate::publisher::{self, Kept};
use crate::run_dir::{Checkpoint, RunDir};
use crate::scoreboard::OtherWeights;
use crate::train::TrainedPolicy;
use crate::trouble::{Saved, Trouble};

/// Most bytes of snapshots that wait for the disk: forty of the paper's size.
const MOST_WAITING: usize = 256 << 20;
/// How long the disk is left alone after it has refused something.
pub(crate) const RETRY: Duration = Duration::from_secs(2);
/// How often a training that waits for the disk looks whether it is to stop.
const GLANCE: Duration = Duration::from_millis(100);

/// Where the training thread leaves its results. Clones are the same place.
#[derive(Clone, Debug, Default)]
pub struct Desk {
    shared: Arc<(Mutex<Waiting>, Condvar)>,
}

#[derive(Debug, Default)]
struct Waiting {
    snapshots: VecDeque<TrainedPolicy>,
    bytes: usize,
    checkpoint: Option<Checkpoint>,
    trained: bool,
    closed: bool,
    /// Since when the thread is at something.
    busy: Option<Instant>,
}

/// The next thing to be done.
#[derive(Debug)]
enum Work {
    Snapshot(TrainedPolicy),
    Checkpoint(Checkpoint),
    /// Everything is on disk, and nothing more will come.
    Trained,
}

impl Desk {
    /// Leaves a policy that is to be kept. Waits only if far too many wait already, and not for ever if `stop` is set.
    pub fn snapshot(&self, policy: TrainedPolicy, stop: &AtomicBool) {
        let mut waiting = self.lock();
        while waiting.bytes > MOST_WAITING && !stop.load(Ordering::Relaxed) {
            waiting = self.shared.1.wait_timeout(waiting, GLANCE).unwrap_or_else(PoisonError::into_inner).0;
        }
        waiting.bytes += policy.policy.bytes.len();
        waiting.snapshots.push_back(policy);
        self.shared.1.notify_all();
    }

    /// Leaves a checkpoint, which takes the place of one that still waits.
    pub fn checkpoint(&self, checkpoint: Checkpoint) {
        self.lock().checkpoint = Some(checkpoint);
        self.shared.1.notify_all();
    }

    /// Says that all gradient steps are done.
    pub fn trained(&self) {
        self.lock().trained = true;
        self.shared.1.notify_all();
    }

    /// Ends the thread as soon as everything is on disk.
    pub fn close(&self) {
        self.lock().closed = true;
        self.shared.1.notify_all();
    }

    /// For how long the thread has been at the same thing: more than seconds is a disk that hangs.
    pub fn busy_for(&self) -> Duration {
        self.lock().busy.map_or(Duration::ZERO, |since| since.elapsed())
    }

    /// What is next. A checkpoint comes after the snapshots before it: who goes on from it does not make them again.
    fn next(&self, beat: &Beat) -> Option<Work> {
        let mut waiting = self.lock();
        loop {
            beat.alive();
            waiting.busy = Some(Instant::now());
            if let Some(policy) = waiting.snapshots.pop_front() {
                return Some(Work::Snapshot(policy));
            }
            if let Some(checkpoint) = waiting.checkpoint.take() {
                return Some(Work::Checkpoint(checkpoint));
            }
            if std::mem::take(&mut waiting.trained) {
                return Some(Work::Trained);
            }
            waiting.busy = None;
            if waiting.closed {
                return None;
            }
            waiting = self.shared.1.wait_timeout(waiting, beat.interval()).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Makes room for more; what was taken is on disk.
    fn done(&self, bytes: usize) {
        self.lock().bytes -= bytes;
        self.shared.1.notify_all();
    }

    /// Puts back what the disk did not take.
    fn put_back(&self, work: Work) {
        let mut waiting = self.lock();
        waiting.busy = None;
        match work {
            Work::Snapshot(policy) => waiting.snapshots.push_front(policy),
            Work::Checkpoint(checkpoint) => {
                waiting.checkpoint.get_or_insert(checkpoint);
            }
            Work::Trained => waiting.trained = true,
        }
    }

    // A thread that panicked here left the queue as it was before its change or after it.
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.shared.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The fields that the snapshots of a run say of their origin.
#[derive(Clone, Debug)]
pub struct Provenance {
    /// Environment that the policy acts in.
    pub task: Task,
    /// Which episodes each snapshot is evaluated on.
    pub plan: EvaluationPlan,
    /// Actions sampled per state in an evaluation.
    pub candidates: u32,
}

/// State of the thread.
pub struct Keeper {
    desk: Desk,
    provenance: Provenance,
    run_dir: RunDir,
    metrics: Metrics,
    publisher: Inbox<publisher::Event>,
    notices: UnboundedSender<Notice>,
    /// Snapshots of an earlier life, by step: training may come by them again.
    known: BTreeMap<u64, Hash>,
    trouble: Trouble,
}

impl Keeper {
    /// State before the first result.
    pub fn new(
        desk: Desk,
        provenance: Provenance,
        run_dir: RunDir,
        metrics: Metrics,
        publisher: Inbox<publisher::Event>,
        notices: UnboundedSender<Notice>,
        known: BTreeMap<u64, Hash>,
    ) -> Self {
        let trouble = Trouble::new(Saved::Run, &metrics.disk, notices.clone());
        Self { desk, provenance, run_dir, metrics, publisher, notices, known, trouble }
    }

    /// The thread's work, until the desk is closed and empty.
    pub fn run(mut self, beat: &Beat) {
        while let Some(work) = self.desk.next(beat) {
            let kept = match &work {
                Work::Snapshot(policy) => self.keep(policy),
                Work::Checkpoint(checkpoint) => self.save(checkpoint),
                Work::Trained => {
                    self.publisher.send(publisher::Event::TrainingCompleted);
                    continue;
                }
            };
            match kept {
                Ok(bytes) => {
                    self.trouble.over(beat);
                    self.desk.done(bytes);
                }
                Err(error) => {
                    self.trouble.refused(beat, &format!("{error:#}"));
                    self.desk.put_back(work);
                    std::thread::sleep(RETRY);
                }
            }
        }
    }

    /// Writes a snapshot; only then is it published and its evaluation opened. Gives the room that it took at the desk.
    fn keep(&mut self, trained: &TrainedPolicy) -> anyhow::Result<usize> {
        let TrainedPolicy { step, policy, evaluate } = trained;
        let Provenance { task, plan: EvaluationPlan { seed, episodes }, candidates } = self.provenance.clone();
        let tensors =
            Origin { environment: task.environment, seed, step: *step, episodes, candidates }.attach(&policy.bytes)?;
        let hash = Hash::of(&tensors);
        self.metrics.evaluation.snapshot_bytes.set(tensors.len() as i64);
        match self.known.get(step) {
            None => self.run_dir.write_snapshot(*step, &tensors)?,
            Some(known) if *known == hash => {}
            // It has scores already: neither overwritten nor published.
            Some(known) => {
                let error = OtherWeights { step: *step, found: hash, scored: known.to_string() };
                self.notices.send(Notice::Failed(other_weights(error))).ok();
                return Ok(policy.bytes.len());
            }
        }
        if *evaluate {
            let kept = Kept { step: *step, kind: policy.kind, hash, tensors };
            self.publisher.send(publisher::Event::Kept(kept));
        }
        Ok(policy.bytes.len())
    }

    fn save(&self, checkpoint: &Checkpoint) -> anyhow::Result<usize> {
        self.run_dir.write_checkpoint(checkpoint)?;
        let Checkpoint { step, state } = checkpoint;
        debug!(step, bytes = state.len(), "checkpoint");
        let disk = &self.metrics.disk;
        disk.checkpoint_step.set(i64::try_from(*step).unwrap_or(i64::MAX));
        disk.checkpoint_bytes.set(state.len() as i64);
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        disk.checkpoint_timestamp.set(now.as_secs_f64());
        Ok(0)
    }
}
