//! Online learning on the thread of training: episodes enter the buffer in the order and at the steps
//! that [`OnlineSchedule`] says. An episode that is left out counts as one without rows.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender};
use std::time::{Duration, Instant};

use quad_dataset::{OnlineEpisode, OnlineSampler, Transitions};
use quad_protocol::Episode;
use quad_run::config::Experiment;
use quad_runtime::Heartbeat;
use tracing::warn;

use super::metrics::OnlineMetrics;
use crate::service::{OnlineSchedule, Opening};

/// Interval at which training checks for a stop while it waits for an episode.
const POLL: Duration = Duration::from_millis(100);

/// Names of online learning's numbers in `metrics.jsonl`, and what they are.
pub(crate) const COLUMNS: [(&str, &str); 3] = [
    ("experience_rows", "Online environment steps that training has absorbed"),
    ("online_return", "Return of the newest online episode"),
    ("experience_wait_seconds", "Time that this learner has waited for experience"),
];

/// Takes episodes with their numbers to training, once they are on the disk.
pub(crate) type Inbox = Sender<(u64, Episode)>;

/// The online learning of a run.
pub(crate) struct OnlineTraining {
    schedule: OnlineSchedule,
    recorded: Receiver<(u64, Episode)>,
    /// Recorded episodes that are not absorbed yet, by number.
    waiting: BTreeMap<u64, Episode>,
    transitions: Arc<Transitions>,
    sampler: OnlineSampler,
    metrics: OnlineMetrics,
}

/// An episode that does not fit the run's transitions, or is missing from the run's experience.
#[derive(Debug, thiserror::Error)]
pub(crate) enum OnlineError {
    #[error(
        "the experience of the run does not have episode {0}, which its checkpoint has learned from"
    )]
    Missing(u64),
    #[error("online episode {number} cannot be learned from")]
    Rows { number: u64, source: quad_dataset::Problem },
}

impl OnlineTraining {
    /// The online learning of an experiment, before its first episode.
    pub fn new(
        experiment: &Experiment,
        transitions: Arc<Transitions>,
        recorded: Receiver<(u64, Episode)>,
        metrics: OnlineMetrics,
    ) -> Option<Self> {
        let online = experiment.online.clone()?;
        let (seed, begin) = (experiment.seed, experiment.steps);
        let sampler = OnlineSampler::new(experiment.batch_size as usize, online.share, seed);
        metrics.target.set(i64::try_from(online.steps).unwrap_or(i64::MAX));
        let (schedule, waiting) = (OnlineSchedule::new(online, begin, seed), BTreeMap::new());
        Some(Self { schedule, recorded, waiting, transitions, sampler, metrics })
    }

    /// True from the first online gradient step on.
    pub fn has_begun(&self, step: u64) -> bool {
        self.schedule.has_begun(step)
    }

    /// True if online episodes may be played with the policy after this gradient step.
    pub fn is_snapshot(&self, step: u64) -> bool {
        self.schedule.is_snapshot(step)
    }

    /// Absorbs the episodes that a checkpoint of this step has learned from.
    pub fn resume(&mut self, step: u64) -> Result<(), OnlineError> {
        self.waiting.extend(self.recorded.try_iter());
        while self.has_begun(step) && self.schedule.due() < step {
            let number = self.schedule.next_episode();
            let episode = self.waiting.remove(&number).ok_or(OnlineError::Missing(number))?;
            self.absorb(&episode)?;
        }
        Ok(())
    }

    /// True if gradient step `step` is the last that the rows so far allow.
    pub fn is_due(&self, step: u64) -> bool {
        step == self.schedule.due()
    }

    /// Waits for the next episode and absorbs it. False if training is to `stop`.
    pub fn absorb_next(
        &mut self,
        stop: &AtomicBool,
        beat: &Heartbeat,
    ) -> Result<bool, OnlineError> {
        while !stop.load(Ordering::Relaxed) {
            if let Some(episode) = self.waiting.remove(&self.schedule.next_episode()) {
                return self.absorb(&episode).map(|()| true);
            }
            beat.alive();
            let begin = Instant::now();
            self.waiting.extend(self.recorded.recv_timeout(POLL));
            self.metrics.wait_seconds.inc_by(begin.elapsed().as_secs_f64());
        }
        Ok(false)
    }

    /// Episodes that are open since the last call and not recorded yet.
    pub fn take_openings(&mut self) -> Vec<Opening> {
        self.waiting.extend(self.recorded.try_iter());
        let mut openings = self.schedule.take_openings();
        openings.retain(|opening| !self.waiting.contains_key(&opening.episode));
        openings
    }

    /// The next episode, unless it is recorded.
    pub fn awaited(&self) -> Option<u64> {
        Some(self.schedule.next_episode()).filter(|next| !self.waiting.contains_key(next))
    }

    fn absorb(&mut self, episode: &Episode) -> Result<(), OnlineError> {
        let (number, metrics) = (self.schedule.next_episode(), &self.metrics);
        let rows = OnlineEpisode {
            observations: &episode.observations,
            actions: &episode.actions,
            rewards: &episode.rewards,
            terminated: episode.terminated,
        };
        let added = self.transitions.add_episode(rows);
        let far = added.map_err(|source| OnlineError::Rows { number, source })?;
        self.schedule.absorb(if far.is_some() { 0 } else { episode.rewards.len() as u64 });
        if let Some(far) = far {
            warn!(
                episode = number,
                seed = episode.score.seed,
                "training leaves out an online episode: {far}"
            );
            metrics.left_out.inc();
        } else {
            metrics.rows.set(i64::try_from(self.schedule.rows()).unwrap_or(i64::MAX));
            metrics.episodes.inc();
            metrics.episode_return.set(episode.score.episode_return);
            metrics.score.set(episode.score.score);
        }
        Ok(())
    }

    /// Numbers for a line of `metrics.jsonl`.
    pub fn row(&self) -> Vec<(&'static str, f64)> {
        let metrics = &self.metrics;
        let values =
            [self.schedule.rows() as f64, metrics.episode_return.get(), metrics.wait_seconds.get()];
        COLUMNS.iter().map(|(name, _)| *name).zip(values).collect()
    }

    /// The rows of gradient step `step`, the first of which is 1.
    pub fn rows(&mut self, step: u64) -> &[u32] {
        let (len, experience) = (self.transitions.len(), self.transitions.experience_len());
        self.sampler.indices(step, len, experience)
    }
}
