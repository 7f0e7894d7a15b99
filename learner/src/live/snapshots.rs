//! The thread `snapshots`: writes the output of training to the disk, then opens the evaluation of
//! each snapshot, then publishes the snapshot.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::anyhow;
use quad_protocol::Hash;
use quad_run::folder::{Checkpoint, Log, RunDirError};
use quad_runtime::{Heartbeat, hinted};
use tracing::debug;

use super::carrier::Carrier;
use super::disk::DiskStatus;
use super::events::Event;
use super::metrics::unix_time;
use super::weights::Weights;
use crate::service::{Input, Opening, OtherWeights};
use crate::train::{Output, OutputQueue, TrainedPolicy};

/// Pause after the disk has refused a write.
pub(super) const RETRY: Duration = Duration::from_secs(2);

const OTHER_WEIGHTS: &str = "another kind of processor, another number of threads or another version computes other bits: \
                             continue where the run was before, or begin anew with --fresh";

const NO_SNAPSHOT: &str = "put the file back into snapshots/; or remove checkpoints/ of later steps, and training makes it \
                           again";

pub(super) struct Snapshots {
    pub queue: OutputQueue,
    /// `metrics.jsonl`.
    pub rows: Log,
    pub weights: Weights,
    pub carrier: Carrier,
    /// Snapshots of earlier processes, by step: training may reach their steps again.
    pub saved: BTreeMap<u64, Hash>,
    pub disk: DiskStatus,
}

impl Snapshots {
    /// The thread's work, until the queue is closed and empty. It repeats a write that the disk
    /// refuses until the disk accepts it.
    pub fn run(mut self, beat: &Heartbeat) -> anyhow::Result<()> {
        while let Some(output) = self.queue.next(beat) {
            while let Err(error) = self.save(&output) {
                match error.downcast_ref() {
                    Some(RunDirError::Io { .. }) => {
                        self.disk.refused(beat, &format!("{error:#}"));
                        std::thread::sleep(RETRY);
                        beat.alive();
                    }
                    Some(other) => {
                        let hint = other.hint();
                        return Err(hinted(error, hint));
                    }
                    None if error.is::<OtherWeights>() => return Err(hinted(error, OTHER_WEIGHTS)),
                    None => return Err(error),
                }
            }
            self.disk.accepted(beat);
        }
        Ok(())
    }

    fn save(&mut self, output: &Output) -> anyhow::Result<()> {
        match output {
            Output::Snapshot(policy) => self.snapshot(policy)?,
            Output::Online(opening) => self.open_online(opening)?,
            Output::Waits(episode) => drop(self.carrier.carry(Input::Waits(*episode))),
            Output::Checkpoint(checkpoint) => self.checkpoint(checkpoint)?,
            Output::Rows(rows) => self.rows.append(rows)?,
            Output::Ended(outcome) => self.carrier.events.send(Event::TrainingEnded(*outcome)),
        }
        Ok(())
    }

    /// Writes a snapshot, then opens its evaluation and publishes it.
    fn snapshot(&mut self, trained: &TrainedPolicy) -> anyhow::Result<()> {
        let &TrainedPolicy { step, ref file, evaluate, online } = trained;
        let hash = Hash::new(file);
        let metrics = &self.carrier.metrics.evaluation;
        metrics.snapshot_bytes.set(file.len() as i64);
        match self.saved.get(&step) {
            None => self.weights.run_dir.write_snapshot(step, file)?,
            Some(saved) if *saved == hash => {}
            // The step has scores already: the snapshot is neither overwritten nor published.
            Some(saved) => {
                return Err(OtherWeights { step, trained: hash, scored: saved.to_string() }.into());
            }
        }
        if online {
            self.saved.insert(step, hash);
        }
        if evaluate {
            // The jobs must exist first: evaluators claim one as soon as the snapshot arrives.
            self.carrier.open(step, hash)?;
            metrics.snapshots_published.inc();
            self.carrier.events.send(Event::Published { step });
        }
        if evaluate || online {
            self.weights.publish(step, hash, file.clone())?;
        }
        Ok(())
    }

    fn open_online(&self, opening: &Opening) -> anyhow::Result<()> {
        let step = opening.step;
        let Some(hash) = self.saved.get(&step) else {
            let error = anyhow!("the snapshot of step {step}, which is to play, is missing");
            return Err(hinted(error, NO_SNAPSHOT));
        };
        self.carrier.carry(Input::Opened(*opening, *hash));
        Ok(())
    }

    fn checkpoint(&self, checkpoint: &Checkpoint) -> anyhow::Result<()> {
        self.weights.run_dir.write_checkpoint(checkpoint)?;
        let Checkpoint { step, state } = checkpoint;
        debug!(step, bytes = state.len(), "checkpoint");
        let disk = &self.carrier.metrics.disk;
        disk.checkpoint_step.set(i64::try_from(*step).unwrap_or(i64::MAX));
        disk.checkpoint_bytes.set(state.len() as i64);
        disk.checkpoint_timestamp.set(unix_time());
        Ok(())
    }
}
