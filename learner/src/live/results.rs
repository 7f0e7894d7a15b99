//! The thread `results`: writes scores and experience to the disk, as the service orders.
//!
//! All that arrived during the last write goes together, in one write and one synchronization. A
//! slow disk delays only acknowledgments.

use std::collections::VecDeque;
use std::sync::Arc;

use anyhow::Context;
use quad_run::folder::{ExperienceLog, Log, RunDirError, ScoreLine};
use quad_runtime::Heartbeat;

use super::carrier::Carrier;
use super::disk::DiskStatus;
use crate::service::{Input, Order};

pub(super) struct Results {
    /// `scores.jsonl`.
    pub scores: Log,
    /// `experience.log`, in an online run.
    pub experience: Option<ExperienceLog>,
    pub carrier: Carrier,
    pub disk: DiskStatus,
}

impl Results {
    /// The thread's work, until the last delivery.
    pub fn run(mut self, beat: &Heartbeat) -> anyhow::Result<()> {
        while self.carrier.wait_for_deliveries(beat.interval()) {
            beat.alive();
            let mut orders = VecDeque::from(self.carrier.carry(Input::Flush));
            while let Some(order) = orders.pop_front() {
                orders.extend(match order {
                    Order::Decode(frame) => {
                        let episode = frame.decode();
                        self.carrier.carry(Input::Decoded(frame, episode))
                    }
                    Order::Append { scores, frames } => {
                        let results = self.append(&scores, &frames, beat)?;
                        self.carrier.carry(Input::Appended(results))
                    }
                    _ => Vec::new(),
                });
            }
        }
        Ok(())
    }

    fn append(
        &mut self,
        scores: &[ScoreLine],
        frames: &[Arc<Vec<u8>>],
        beat: &Heartbeat,
    ) -> anyhow::Result<[Result<(), String>; 2]> {
        let scores = if scores.is_empty() { Ok(()) } else { self.scores.append(scores) };
        let experience = match &mut self.experience {
            _ if frames.is_empty() => Ok(()),
            Some(log) => log.append(frames.iter().map(|frame| frame.as_slice())),
            None => None.context("a run without online steps has got an episode")?,
        };
        let text = |error: RunDirError| format!("{:#}", anyhow::Error::from(error));
        let results = [scores.map_err(text), experience.map_err(text)];
        match results.iter().find_map(|result| result.as_ref().err()) {
            None => self.disk.accepted(beat),
            Some(error) => self.disk.refused(beat, error),
        }
        Ok(results)
    }
}
