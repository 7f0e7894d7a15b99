//! The thread `snapshots`: writes the output of training to the disk, then opens the evaluation of
//! each snapshot, then publishes the snapshot.

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use quad_protocol::Hash;
use quad_run::folder::{Checkpoint, Log, RunDir, RunDirError};
use quad_runtime::{Heartbeat, hinted};
use tracing::debug;

use super::disk::DiskStatus;
use super::events::{Event, Events};
use super::metrics::Metrics;
use super::weights::Weights;
use crate::evaluation::OtherWeights;
use crate::train::{Outbox, TrainedPolicy, Work};

/// Pause after the disk has refused a write.
pub(super) const RETRY: Duration = Duration::from_secs(2);

/// State of the thread.
pub(super) struct Snapshots {
    pub outbox: Outbox,
    pub run_dir: RunDir,
    /// `metrics.jsonl`.
    pub rows: Log,
    pub weights: Weights,
    pub metrics: Metrics,
    pub events: Events,
    /// Snapshots of earlier processes, by step: training may reach their steps again.
    pub known: BTreeMap<u64, Hash>,
    pub disk: DiskStatus,
}

impl Snapshots {
    /// The thread's work, until the outbox is closed and empty. It repeats a write that the disk
    /// refuses until the disk accepts it.
    pub fn run(mut self, beat: &Heartbeat) -> anyhow::Result<()> {
        while let Some(work) = self.outbox.next(beat) {
            match self.carry_out(&work) {
                Ok(()) => {
                    self.disk.well(beat);
                    self.outbox.done(&work);
                }
                Err(error) if matches!(error.downcast_ref(), Some(RunDirError::Io { .. })) => {
                    self.disk.refused(beat, &format!("{error:#}"));
                    self.outbox.put_back(work);
                    std::thread::sleep(RETRY);
                }
                Err(error) => return Err(with_hint(error)),
            }
        }
        Ok(())
    }

    fn carry_out(&mut self, work: &Work) -> anyhow::Result<()> {
        match work {
            Work::Snapshot(policy) => self.snapshot(policy),
            Work::Checkpoint(checkpoint) => self.checkpoint(checkpoint),
            Work::Rows(rows) => Ok(self.rows.append(rows)?),
            Work::Ended(outcome) => {
                self.events.send(Event::TrainingEnded(*outcome)).ok();
                Ok(())
            }
        }
    }

    /// Writes a snapshot, then opens its evaluation and publishes it.
    fn snapshot(&mut self, trained: &TrainedPolicy) -> anyhow::Result<()> {
        let TrainedPolicy { step, file, evaluate } = trained;
        let hash = Hash::of(file);
        self.metrics.evaluation.snapshot_bytes.set(file.len() as i64);
        match self.known.get(step) {
            None => self.run_dir.write_snapshot(*step, file)?,
            Some(known) if *known == hash => {}
            // The step has scores already: the snapshot is neither overwritten nor published.
            Some(known) => {
                return Err(
                    OtherWeights { step: *step, found: hash, scored: known.to_string() }.into()
                );
            }
        }
        if *evaluate {
            self.weights.publish(*step, hash, file.clone())?;
            self.metrics.evaluation.snapshots_published.inc();
            self.events.send(Event::Published { step: *step }).ok();
        }
        Ok(())
    }

    fn checkpoint(&self, checkpoint: &Checkpoint) -> anyhow::Result<()> {
        self.run_dir.write_checkpoint(checkpoint)?;
        let Checkpoint { step, state } = checkpoint;
        debug!(step, bytes = state.len(), "checkpoint");
        let disk = &self.metrics.disk;
        disk.checkpoint_step.set(i64::try_from(*step).unwrap_or(i64::MAX));
        disk.checkpoint_bytes.set(state.len() as i64);
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        disk.checkpoint_timestamp.set(now.as_secs_f64());
        Ok(())
    }
}

/// Adds a hint.
fn with_hint(error: anyhow::Error) -> anyhow::Error {
    if let Some(hint) = error.downcast_ref().map(RunDirError::hint) {
        return hinted(error, hint);
    }
    match error.is::<OtherWeights>() {
        true => hinted(
            error,
            "another kind of processor, another number of threads or another version computes other bits: continue where the \
             run was before, or begin anew with --fresh",
        ),
        false => error,
    }
}
