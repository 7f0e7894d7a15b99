//! The folder of a run, as it would be on the disk.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;

use quad_protocol::{Episode, EpisodeScore, Hash, decode, online_seed};
use quad_run::folder::{SavedScores, ScoreLine};

use crate::settings::Settings;
use crate::training::State;

#[derive(Debug, Default)]
pub struct Disk {
    pub scores: Vec<ScoreLine>,
    pub experience: Vec<Arc<Vec<u8>>>,
    pub snapshots: BTreeMap<u64, Hash>,
    pub checkpoint: Option<State>,
    /// True while it refuses writes.
    pub fails: bool,
}

/// Online episodes that a learner finds when it starts.
pub struct Experience {
    /// By number.
    pub recorded: BTreeMap<u64, Episode>,
    /// Seeds of the run's episodes so far, with the hash of those in the log.
    pub seeds: Vec<(u64, Option<Hash>)>,
}

impl Disk {
    /// Appends results: all of them, or none if it fails.
    pub fn append(
        &mut self,
        scores: &[ScoreLine],
        frames: &[Arc<Vec<u8>>],
    ) -> [Result<(), String>; 2] {
        if self.fails {
            return [Err("no space left".to_owned()), Err("no space left".to_owned())];
        }
        self.scores.extend_from_slice(scores);
        self.experience.extend_from_slice(frames);
        [Ok(()), Ok(())]
    }

    /// The scores of each step.
    pub fn saved_scores(&self) -> BTreeMap<u64, SavedScores> {
        let mut saved = BTreeMap::new();
        for line in &self.scores {
            let weights = line.weights.clone();
            let scores = saved
                .entry(line.step)
                .or_insert_with(|| SavedScores { weights, episodes: Vec::new() });
            scores.episodes.push(line.episode());
        }
        saved
    }

    /// Online episodes, for a learner that starts; none in a run without.
    pub fn online(&self, settings: &Settings) -> Result<Experience, String> {
        let lag = settings.online.as_ref().map_or(0, |online| online.lag);
        let mut episodes = HashMap::new();
        for frame in &self.experience {
            let episode: Episode = decode(frame).map_err(|error| error.to_string())?;
            if episodes.insert(episode.score.seed, (Hash::new(frame), episode)).is_some() {
                return Err("an online episode is recorded twice".to_owned());
            }
        }
        let (mut recorded, mut seeds) = (BTreeMap::new(), Vec::new());
        for number in 0..episodes.len() as u64 + u64::from(lag) {
            let seed = online_seed(0, number);
            if let Some((hash, episode)) = episodes.remove(&seed) {
                recorded.insert(number, episode);
                seeds.push((seed, Some(hash)));
            } else if self.snapshots.contains_key(&settings.offline_steps) {
                seeds.push((seed, None));
            }
        }
        match episodes.is_empty() {
            true => Ok(Experience { recorded, seeds }),
            false => Err("there is an online episode that the run never opened".to_owned()),
        }
    }

    /// The recorded score of an episode.
    pub fn score(&self, step: u64, seed: u64) -> Option<EpisodeScore> {
        let line = self.scores.iter().find(|line| (line.step, line.seed) == (step, seed));
        line.map(ScoreLine::episode)
    }

    /// An error if an episode has two scores.
    pub fn check(&self) -> Result<(), String> {
        let mut seen = BTreeSet::new();
        for line in &self.scores {
            if !seen.insert((line.step, line.seed)) {
                return Err(format!("step {}, seed {} is scored twice", line.step, line.seed));
            }
        }
        Ok(())
    }
}
