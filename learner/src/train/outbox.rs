//! The queue from training to the disk.
//!
//! A disk that is full or hangs delays the thread that takes from here, and not training. What
//! waits is bounded: of checkpoints the newest, of rows so many that people miss none, of snapshots
//! so many bytes that training continues for hours before it waits for the disk, too.

use std::collections::VecDeque;
use std::mem;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use quad_run::folder::Checkpoint;
use quad_runtime::Heartbeat;

use super::results::{Outcome, Row, TrainedPolicy};

/// Most bytes of snapshots that wait for the disk: forty of the paper's size.
const MOST_BYTES: usize = 256 << 20;
/// Most lines of `metrics.jsonl` that wait for it; more push out the oldest.
const MOST_ROWS: usize = 10_000;
/// How often a training that waits for the disk looks whether it is to stop.
const GLANCE: Duration = Duration::from_millis(100);

/// The next thing to be done for training.
#[derive(Debug)]
pub(crate) enum Work {
    Snapshot(TrainedPolicy),
    Checkpoint(Checkpoint),
    Rows(Vec<Row>),
    /// Training has ended so, and everything before this is done.
    Ended(Outcome),
}

/// Where training leaves its results. Clones are the same place.
#[derive(Clone, Debug, Default)]
pub(crate) struct Outbox {
    shared: Arc<(Mutex<Waiting>, Condvar)>,
}

#[derive(Debug, Default)]
struct Waiting {
    snapshots: VecDeque<TrainedPolicy>,
    /// Bytes of these snapshots and of the one that is being written.
    bytes: usize,
    checkpoint: Option<Checkpoint>,
    rows: Vec<Row>,
    ended: Option<Outcome>,
    closed: bool,
}

impl Outbox {
    /// Leaves a policy. Waits if far too many wait already, unless training is to `stop`.
    pub fn snapshot(&self, policy: TrainedPolicy, stop: &AtomicBool, beat: &Heartbeat) {
        let mut waiting = self.lock();
        while waiting.bytes > MOST_BYTES && !stop.load(Ordering::Relaxed) {
            beat.alive();
            waiting = self
                .shared
                .1
                .wait_timeout(waiting, GLANCE)
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
        waiting.bytes += policy.file.len();
        waiting.snapshots.push_back(policy);
        self.shared.1.notify_all();
    }

    /// Leaves a checkpoint, which takes the place of one that still waits.
    pub fn checkpoint(&self, checkpoint: Checkpoint) {
        self.lock().checkpoint = Some(checkpoint);
        self.shared.1.notify_all();
    }

    /// Leaves a line of `metrics.jsonl`.
    pub fn row(&self, row: Row) {
        self.lock().add_rows(vec![row]);
        self.shared.1.notify_all();
    }

    /// Says how training has ended.
    pub fn ended(&self, outcome: Outcome) {
        self.lock().ended = Some(outcome);
        self.shared.1.notify_all();
    }

    /// Nothing more will come: [`next`](Self::next) gives what is left, and then nothing.
    pub fn close(&self) {
        self.lock().closed = true;
        self.shared.1.notify_all();
    }

    /// What is next, as soon as there is something; nothing once the outbox is closed and empty.
    /// Snapshots go before the checkpoint: a run that is resumed from a checkpoint does not make
    /// earlier snapshots again.
    pub fn next(&self, beat: &Heartbeat) -> Option<Work> {
        let mut waiting = self.lock();
        loop {
            beat.alive();
            if let Some(work) = waiting.next() {
                return Some(work);
            }
            if waiting.closed {
                return None;
            }
            waiting = self
                .shared
                .1
                .wait_timeout(waiting, beat.interval())
                .unwrap_or_else(PoisonError::into_inner)
                .0;
        }
    }

    /// What was taken is on the disk: makes room for more.
    pub fn done(&self, work: &Work) {
        if let Work::Snapshot(policy) = work {
            self.lock().bytes -= policy.file.len();
            self.shared.1.notify_all();
        }
    }

    /// Puts back what the disk did not take, in its old place.
    pub fn put_back(&self, work: Work) {
        let mut waiting = self.lock();
        match work {
            Work::Snapshot(policy) => waiting.snapshots.push_front(policy),
            Work::Checkpoint(checkpoint) => drop(waiting.checkpoint.get_or_insert(checkpoint)),
            Work::Rows(rows) => {
                let newer = mem::replace(&mut waiting.rows, rows);
                waiting.add_rows(newer);
            }
            Work::Ended(outcome) => waiting.ended = Some(outcome),
        }
    }

    // A thread that panicked here left the queue as it was before its change or after it.
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.shared.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Waiting {
    fn next(&mut self) -> Option<Work> {
        if let Some(policy) = self.snapshots.pop_front() {
            return Some(Work::Snapshot(policy));
        }
        if let Some(checkpoint) = self.checkpoint.take() {
            return Some(Work::Checkpoint(checkpoint));
        }
        if !self.rows.is_empty() {
            return Some(Work::Rows(mem::take(&mut self.rows)));
        }
        self.ended.take().map(Work::Ended)
    }

    fn add_rows(&mut self, rows: Vec<Row>) {
        self.rows.extend(rows);
        let excess = self.rows.len().saturating_sub(MOST_ROWS);
        self.rows.drain(..excess);
    }
}
