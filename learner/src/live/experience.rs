//! The experience that a run has when its learner starts.

use std::collections::HashMap;

use anyhow::Context;
use quad_protocol::{Episode, Hash, online_seed};
use quad_run::config::Experiment;
use quad_run::folder::{ExperienceLog, RunDir};
use quad_runtime::Hint;

use crate::train::Inbox;

/// The hint of a checkpoint or log without the other.
pub(super) const OTHER_FOLDER: &str = "experience.log belongs to the run: copy it from where the checkpoint is from, or begin anew with --fresh";

pub(super) struct Experience {
    pub log: ExperienceLog,
    /// Seeds of the run's episodes so far, with the frame's hash of those in the log. An earlier
    /// learner may have opened the others.
    pub episodes: Vec<(u64, Option<Hash>)>,
}

impl Experience {
    /// Opens the run's log, and puts what it has into the inbox. An episode that is not there may
    /// have been played, if the snapshot from which online learning begins is there.
    pub fn open(dir: &RunDir, experiment: &Experiment, inbox: &Inbox) -> anyhow::Result<Self> {
        let (log, records) = dir.experience_log()?;
        let by_seed = |(hash, episode): (Hash, Episode)| (episode.score.seed, (hash, episode));
        let mut episodes: HashMap<u64, _> = records.into_iter().map(by_seed).collect();
        let count = episodes.len() as u64;
        let lag = experiment.online.as_ref().map_or(0, |online| online.lag);
        let has_begun = dir.snapshots()?.contains(&experiment.steps);
        let mut seeds = Vec::new();
        // Seeds are those of the first episodes: more were never open.
        for number in 0..count + u64::from(lag) {
            let seed = online_seed(experiment.seed, number);
            if let Some((hash, episode)) = episodes.remove(&seed) {
                seeds.push((seed, Some(hash)));
                inbox.send((number, episode)).ok();
            } else if has_begun {
                seeds.push((seed, None));
            }
        }
        let error = "experience.log has episodes of another run";
        episodes.is_empty().then_some(()).context(error).hint(OTHER_FOLDER)?;
        Ok(Self { log, episodes: seeds })
    }
}
