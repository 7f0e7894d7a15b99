//! Runs many episodes as one batch.

use std::time::{Duration, Instant};

use quad_protocol::{Episode, EpisodeScore, Hash, Name};
use rayon::prelude::*;
use tracing::warn;

use super::environment::{Environment, EnvironmentError};

/// A batch of episodes that advance together, with one policy call and one control period per
/// [`step`](Rollout::step).
///
/// Episodes that have ended leave the batch. An episode's score is a function of its seed and the
/// policy, if the policy treats its rows independently; so each episode has its own policy state
/// `S`.
pub struct Rollout<S, E: ?Sized = dyn Environment> {
    observation_dim: usize,
    action_dim: usize,
    live: Vec<Live<E>>,
    /// Policy state of each live episode.
    states: Vec<S>,
    /// [live, observation_dim]
    observations: Vec<f32>,
    /// [live, action_dim]
    actions: Vec<f32>,
    /// Ended episodes, in the order of their ends.
    ended: Vec<Live<E>>,
}

struct Live<E: ?Sized> {
    environment: Box<E>,
    /// Index among the seeds.
    index: usize,
    score: EpisodeScore,
    record: Option<Episode>,
    ended: bool,
}

/// Effort of one step of a batch.
#[derive(Clone, Copy, Debug, Default)]
pub struct Stepped {
    pub steps: u64,
    /// Episodes that have ended.
    pub ended: u32,
    /// Time spent in the policy.
    pub select: Duration,
    pub physics: Duration,
}

impl<S, E: Environment + ?Sized> Rollout<S, E> {
    /// Starts an episode per seed, each in an environment that `make` makes and with a policy state
    /// that `begin` makes. The pair has the policy's sizes of an observation and an action.
    pub fn new(
        mut make: impl FnMut() -> Result<Box<E>, EnvironmentError>,
        (observation_dim, action_dim): (usize, usize),
        seeds: &[u64],
        begin: impl FnMut(u64) -> S,
    ) -> Result<Self, EnvironmentError> {
        let start = |(index, &seed)| {
            let mut environment = make()?;
            environment.reset(seed)?;
            let score = EpisodeScore { seed, episode_return: 0.0, length: 0, score: 0.0 };
            Ok(Live { environment, index, score, record: None, ended: false })
        };
        let live = seeds.iter().enumerate().map(start);
        Ok(Self {
            observation_dim,
            action_dim,
            live: live.collect::<Result<_, _>>()?,
            states: seeds.iter().copied().map(begin).collect(),
            observations: Vec::new(),
            actions: Vec::new(),
            ended: Vec::new(),
        })
    }

    /// Records the episodes, which have just started, as experience with the snapshot of this step
    /// and hash, by a policy with this arithmetic. They end before a step that cannot be learned from.
    pub fn recording(mut self, step: u64, weights: Hash, precision: &Name) -> Self {
        for live in &mut self.live {
            let seed = live.score.seed;
            live.record = Some(Episode::new(step, weights, precision.clone(), seed));
        }
        self
    }

    /// Advances every live episode by one control period. `select` gets the observations [n,
    /// observation_dim] and the policy's states [n], and fills in the actions [n, action_dim].
    ///
    /// # Errors
    ///
    /// `select` fails before any episode advances. After any other error the batch is unusable: an
    /// environment has failed, or a return or score is not finite.
    pub fn step<F: From<EnvironmentError>>(
        &mut self,
        select: impl FnOnce(&[f32], &mut [S], &mut [f32]) -> Result<(), F>,
    ) -> Result<Stepped, F> {
        let start = Instant::now();
        self.observe()?;
        self.actions.resize(self.live.len() * self.action_dim, 0.0);
        select(&self.observations, &mut self.states, &mut self.actions)?;
        let selected = Instant::now();

        if rayon::current_num_threads() > 1 && self.live.len() > 1 {
            let actions = self.actions.par_chunks_exact(self.action_dim);
            let episodes = self.live.par_iter_mut().zip(actions);
            episodes.try_for_each(|(episode, action)| episode.step(action))?;
        } else {
            let mut actions = self.actions.chunks_exact(self.action_dim);
            let mut episodes = self.live.iter_mut().zip(&mut actions);
            episodes.try_for_each(|(episode, action)| episode.step(action))?;
        }
        let (steps, ended) = (self.live.len() as u64, self.collect_ended()?);
        Ok(Stepped { steps, ended, select: selected - start, physics: selected.elapsed() })
    }

    fn observe(&mut self) -> Result<(), EnvironmentError> {
        self.observations.clear();
        for live in &self.live {
            self.observations.extend(observe(&*live.environment, self.observation_dim)?);
            live.check_observation()?;
        }
        Ok(())
    }

    fn collect_ended(&mut self) -> Result<u32, EnvironmentError> {
        let before = self.live.len();
        for row in (0..before).rev() {
            if self.live[row].ended {
                let mut episode = self.live.swap_remove(row);
                self.states.swap_remove(row);
                let score = episode.score()?;
                if let Some(record) = &mut episode.record {
                    record.score = score;
                    // Before a step that was cut off, it is there already.
                    if record.observations.len() == record.rewards.len() * self.observation_dim {
                        let last = observe(&*episode.environment, self.observation_dim)?;
                        record.observations.extend(last);
                    }
                }
                self.ended.push(episode);
            }
        }
        Ok((before - self.live.len()) as u32)
    }

    pub fn is_done(&self) -> bool {
        self.live.is_empty()
    }

    /// Scores of the ended episodes, in the order of the seeds.
    pub fn into_scores(self) -> Vec<EpisodeScore> {
        self.into_ended().map(|episode| episode.score).collect()
    }

    /// Scores of the ended episodes in the order of the seeds, and the episodes if they were
    /// [recorded](Self::recording).
    pub fn into_records(self) -> Vec<(EpisodeScore, Option<Episode>)> {
        self.into_ended().map(|episode| (episode.score, episode.record)).collect()
    }

    /// The environments of the ended episodes, in the order of the seeds.
    pub fn into_environments(self) -> Vec<E>
    where
        E: Sized,
    {
        self.into_ended().map(|episode| *episode.environment).collect()
    }

    fn into_ended(mut self) -> impl Iterator<Item = Live<E>> {
        self.ended.sort_unstable_by_key(|episode| episode.index);
        self.ended.into_iter()
    }
}

/// The observation of an environment, rounded.
fn observe(
    environment: &(impl Environment + ?Sized),
    expected: usize,
) -> Result<impl Iterator<Item = f32>, EnvironmentError> {
    let observation = environment.observation();
    let size = observation.len();
    match size == expected {
        true => Ok(observation.iter().map(|&value| value as f32)),
        false => Err(EnvironmentError::Observation { size, expected }),
    }
}

impl<E: Environment + ?Sized> Live<E> {
    fn step(&mut self, action: &[f32]) -> Result<(), EnvironmentError> {
        if let Some(record) = &mut self.record {
            let observation = self.environment.observation();
            record.observations.extend(observation.iter().map(|&value| value as f32));
        }
        let step = self.environment.step(action)?;
        self.score.length += 1;
        if self.record.is_some()
            && let Err(error) = self.check(step.reward)
        {
            return self.cut_off(error);
        }
        if let Some(record) = &mut self.record {
            if step.intervention.is_some() {
                record.interventions.push(self.score.length - 1);
            }
            let taken = step.intervention.as_deref().or(step.clipped.as_deref());
            record.actions.extend(taken.unwrap_or(action));
            record.rewards.push(step.reward as f32);
            record.terminated = step.terminated;
        } else if step.intervention.is_some() {
            return Err(EnvironmentError::Intervention(self.score.seed));
        }
        self.score.episode_return += step.reward;
        // A sum that is not finite stays so.
        let is_finite = self.score.episode_return.is_finite();
        // A longer one could not be delivered.
        let sizes = (self.environment.observation().len(), action.len());
        let is_full =
            self.record.is_some() && self.score.length as usize >= Episode::most_steps(sizes);
        self.ended = step.terminated || step.truncated || !is_finite || is_full;
        Ok(())
    }

    /// Ends the episode before its last step, as truncated; fails if it has no other.
    fn cut_off(&mut self, error: EnvironmentError) -> Result<(), EnvironmentError> {
        self.score.length -= 1;
        if self.score.length == 0 {
            return Err(error);
        }
        warn!("an online episode is cut off before its last step: {error}");
        self.ended = true;
        Ok(())
    }

    /// Refuses what a step gave if no learner could learn from it.
    fn check(&self, reward: f64) -> Result<(), EnvironmentError> {
        let episode_return = self.score.episode_return + reward;
        if !(reward as f32).is_finite() || !EpisodeScore::is_in_range(episode_return) {
            return Err(self.unusable("reward", 0, reward));
        }
        self.check_observation()
    }

    fn check_observation(&self) -> Result<(), EnvironmentError> {
        let mut numbers = self.environment.observation().iter().copied().enumerate();
        match numbers.find(|(_, number)| !(*number as f32).is_finite()) {
            Some((index, number)) => Err(self.unusable("observation", index, number)),
            None => Ok(()),
        }
    }

    fn unusable(&self, array: &'static str, index: usize, value: f64) -> EnvironmentError {
        let (name, step) = (self.environment.name().to_owned(), self.score.length);
        EnvironmentError::Unusable { name, array, index, value, step, seed: self.score.seed }
    }

    fn score(&mut self) -> Result<EpisodeScore, EnvironmentError> {
        let (seed, length) = (self.score.seed, self.score.length);
        let check = |what, value| match EpisodeScore::is_in_range(value) {
            true => Ok(value),
            false => Err(EnvironmentError::NotCounted { what, seed, value, length }),
        };
        let episode_return = check("return", self.score.episode_return)?;
        self.score.score = check("score", self.environment.score(episode_return)?)?;
        Ok(self.score)
    }
}
