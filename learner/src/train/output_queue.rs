//! The queue from training to the disk.
//!
//! A disk that is full or hangs delays the thread that takes from here, and not training. The queue
//! is bounded: it holds the newest checkpoint, rows of hours, and so many bytes of snapshots that
//! training continues for hours before it waits for the disk, too.

use std::collections::VecDeque;
use std::mem;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use quad_run::folder::Checkpoint;
use quad_runtime::Heartbeat;

use super::results::{Outcome, Row, TrainedPolicy};
use crate::service::Opening;

/// Most bytes of snapshots that wait for the disk: forty of the paper's size.
const MOST_BYTES: usize = 256 << 20;
/// Most lines of `metrics.jsonl` that wait for it; more push out the oldest.
const MOST_ROWS: usize = 10_000;
/// Interval at which training checks for a stop while it waits for the disk.
const POLL: Duration = Duration::from_millis(100);

#[derive(Debug)]
pub(crate) enum Output {
    Snapshot(TrainedPolicy),
    /// Online episodes that may be played with a snapshot before.
    Online(Opening),
    /// Training waits for this online episode.
    Waits(u64),
    Checkpoint(Checkpoint),
    Rows(Vec<Row>),
    /// Comes after all other output.
    Ended(Outcome),
}

/// A handle to the queue. Clones share it.
#[derive(Clone, Debug, Default)]
pub(crate) struct OutputQueue {
    shared: Arc<(Mutex<Waiting>, Condvar)>,
}

#[derive(Debug, Default)]
struct Waiting {
    /// Snapshots, and online episodes with them.
    snapshots: VecDeque<Output>,
    checkpoint: Option<Checkpoint>,
    rows: Vec<Row>,
    ended: Option<Outcome>,
    closed: bool,
}

impl OutputQueue {
    /// Adds a policy. Waits while too many bytes wait already, unless training is to `stop`.
    pub fn snapshot(&self, policy: TrainedPolicy, stop: &AtomicBool, beat: &Heartbeat) {
        let mut waiting = self.lock();
        while waiting.bytes() > MOST_BYTES && !stop.load(Ordering::Relaxed) {
            beat.alive();
            waiting = self.wait(waiting, POLL);
        }
        drop(waiting);
        self.push(Output::Snapshot(policy));
    }

    /// Adds output. A checkpoint replaces one that still waits.
    pub fn push(&self, output: Output) {
        let mut waiting = self.lock();
        match output {
            Output::Snapshot(_) | Output::Online(_) | Output::Waits(_) => {
                waiting.snapshots.push_back(output)
            }
            Output::Checkpoint(checkpoint) => waiting.checkpoint = Some(checkpoint),
            Output::Rows(rows) => {
                waiting.rows.extend(rows);
                let surplus = waiting.rows.len().saturating_sub(MOST_ROWS);
                waiting.rows.drain(..surplus);
            }
            Output::Ended(outcome) => waiting.ended = Some(outcome),
        }
        self.shared.1.notify_all();
    }

    /// Declares that nothing more will come.
    pub fn close(&self) {
        self.lock().closed = true;
        self.shared.1.notify_all();
    }

    /// Waits for the next output; `None` once the queue is closed and empty. Snapshots and rows go
    /// before the checkpoint: a run that is resumed from a checkpoint does not make earlier ones
    /// again.
    pub fn next(&self, beat: &Heartbeat) -> Option<Output> {
        let mut waiting = self.lock();
        loop {
            beat.alive();
            let output = waiting.next();
            if output.is_some() || waiting.closed {
                self.shared.1.notify_all();
                return output;
            }
            waiting = self.wait(waiting, beat.interval());
        }
    }

    fn wait<'a>(
        &self,
        waiting: MutexGuard<'a, Waiting>,
        limit: Duration,
    ) -> MutexGuard<'a, Waiting> {
        let woken = self.shared.1.wait_timeout(waiting, limit);
        woken.unwrap_or_else(PoisonError::into_inner).0
    }

    // A thread that panicked here left the queue as it was before its change or after it.
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.shared.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Waiting {
    fn bytes(&self) -> usize {
        let bytes = |output: &Output| match output {
            Output::Snapshot(policy) => policy.file.len(),
            _ => 0,
        };
        self.snapshots.iter().map(bytes).sum()
    }

    fn next(&mut self) -> Option<Output> {
        if let Some(output) = self.snapshots.pop_front() {
            return Some(output);
        }
        if !self.rows.is_empty() {
            return Some(Output::Rows(mem::take(&mut self.rows)));
        }
        if let Some(checkpoint) = self.checkpoint.take() {
            return Some(Output::Checkpoint(checkpoint));
        }
        self.ended.take().map(Output::Ended)
    }
}
