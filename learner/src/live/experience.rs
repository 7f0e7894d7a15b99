//! Online learning of a run when its learner starts, with the experience that it has.

use std::collections::HashMap;
use std::sync::{Arc, mpsc};

use anyhow::Context;
use quad_dataset::Transitions;
use quad_protocol::{Episode, Hash, online_seed};
use quad_run::config::Experiment;
use quad_run::folder::{ExperienceLog, RunDir};
use quad_runtime::Hint;

use crate::train::{Inbox, OnlineMetrics, OnlineTraining};

/// The hint of a checkpoint or log without the other.
const OTHER_FOLDER: &str = "experience.log belongs to the run: copy it from where the checkpoint is from, or begin anew with --fresh";

pub(super) struct Experience {
    pub training: OnlineTraining,
    /// The way of new episodes to training.
    pub inbox: Inbox,
    pub log: ExperienceLog,
    /// Seeds of the run's episodes so far, with the frame's hash of those in the log. An earlier
    /// learner may have opened the others.
    pub episodes: Vec<(u64, Option<Hash>)>,
}

impl Experience {
    /// Opens the run's log, and gives what it has to training, which goes on after gradient step
    /// `step`. An episode that is not there may have been played, if the snapshot from which online
    /// learning begins is there. `None` in a run without online steps.
    pub fn open(
        dir: &RunDir,
        experiment: &Experiment,
        step: u64,
        transitions: Arc<Transitions>,
        metrics: &OnlineMetrics,
    ) -> anyhow::Result<Option<Self>> {
        let (inbox, recorded) = mpsc::channel();
        let training = OnlineTraining::new(experiment, transitions, recorded, metrics.clone());
        let Some(mut training) = training else { return Ok(None) };
        let (log, records) = dir.experience_log()?;
        let by_seed = |(hash, episode): (Hash, Episode)| (episode.score.seed, (hash, episode));
        let mut recorded: HashMap<u64, _> = records.into_iter().map(by_seed).collect();
        let count = recorded.len() as u64;
        let lag = experiment.online.as_ref().map_or(0, |online| online.lag);
        let has_begun = dir.snapshots()?.contains(&experiment.steps);
        let mut episodes = Vec::new();
        // Seeds are those of the first episodes: more were never open.
        for number in 0..count + u64::from(lag) {
            let seed = online_seed(experiment.seed, number);
            if let Some((hash, episode)) = recorded.remove(&seed) {
                episodes.push((seed, Some(hash)));
                inbox.send((number, episode)).ok();
            } else if has_begun {
                episodes.push((seed, None));
            }
        }
        let error = "experience.log has episodes of another run";
        recorded.is_empty().then_some(()).context(error).hint(OTHER_FOLDER)?;
        training.resume(step).hint(OTHER_FOLDER)?;
        Ok(Some(Self { training, inbox, log, episodes }))
    }
}
