//! Runs the episodes of one job as one batch.

use std::time::{Duration, Instant};

use quad_protocol::EpisodeScore;
use rayon::prelude::*;
use serde::Serialize;

use super::environment::{Environment, EnvironmentError};

/// A batch of episodes that advance together: one policy call and one control period per
/// [`step`](Rollout::step).
///
/// Episodes that have ended leave the batch, so the policy sees only live ones. An episode's
/// outcome is a function of its seed and the policy, whatever else is in the batch, as long as the
/// policy treats its rows independently. For that, each episode has its own `S`: what the policy
/// carries from step to step.
pub struct Rollout<S> {
    /// Sizes of an observation and of an action.
    sizes: (usize, usize),
    live: Vec<Episode>,
    /// Row i belongs to `live[i]`, also in the next two fields.
    states: Vec<S>,
    /// live × numbers in an observation
    observations: Vec<f32>,
    /// live × numbers in an action
    actions: Vec<f32>,
    outcomes: Vec<EpisodeOutcome>,
    environment_steps: u64,
    select_time: Duration,
    physics_time: Duration,
}

struct Episode {
    environment: Box<dyn Environment>,
    index: usize,
    seed: u64,
    episode_return: f64,
    length: u32,
    ended: bool,
}

/// The result of one episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EpisodeOutcome {
    /// The index of the episode's seed among the rollout's seeds.
    #[serde(skip)]
    pub index: usize,
    /// The seed of its initial state and of the policy's noise.
    pub seed: u64,
    /// Sum of its rewards, undiscounted.
    #[serde(rename = "return")]
    pub episode_return: f64,
    /// Its number of steps.
    pub length: u32,
    /// Its score, from the environment: D4RL-normalized in the environments of this program.
    pub score: f64,
}

impl<S> Rollout<S> {
    /// Begins an episode for each seed, in an environment of its own that `make` makes. `sizes` are
    /// the policy's sizes of an observation and of an action; `begin` makes the policy's state for
    /// the episode of a seed.
    ///
    /// # Errors
    ///
    /// An environment cannot be made, or cannot begin.
    pub fn new(
        mut make: impl FnMut() -> Result<Box<dyn Environment>, EnvironmentError>,
        sizes: (usize, usize),
        seeds: &[u64],
        begin: impl FnMut(u64) -> S,
    ) -> Result<Self, EnvironmentError> {
        let mut live = Vec::with_capacity(seeds.len());
        for (index, &seed) in seeds.iter().enumerate() {
            let mut environment = make()?;
            environment.reset(seed)?;
            live.push(Episode {
                environment,
                index,
                seed,
                episode_return: 0.0,
                length: 0,
                ended: false,
            });
        }
        Ok(Self {
            sizes,
            live,
            states: seeds.iter().copied().map(begin).collect(),
            observations: Vec::with_capacity(seeds.len() * sizes.0),
            actions: Vec::with_capacity(seeds.len() * sizes.1),
            outcomes: Vec::with_capacity(seeds.len()),
            environment_steps: 0,
            select_time: Duration::ZERO,
            physics_time: Duration::ZERO,
        })
    }

    /// Advances every live episode by one control period.
    ///
    /// Calls `select` once, with the observations of n episodes in a row, the policy's states of
    /// the same episodes, and the buffer for their actions, which it must fill.
    ///
    /// # Errors
    ///
    /// `select` failed, and no episode has advanced; or an environment failed, or an episode's
    /// return or score does not count, and the batch is unusable.
    pub fn step<E: From<EnvironmentError>>(
        &mut self,
        select: impl FnOnce(&[f32], &mut [S], &mut [f32]) -> Result<(), E>,
    ) -> Result<(), E> {
        if self.live.is_empty() {
            return Ok(());
        }
        let start = Instant::now();
        self.observe()?;
        let (_, action_dim) = self.sizes;
        self.actions.resize(self.live.len() * action_dim, 0.0);
        select(&self.observations, &mut self.states, &mut self.actions)?;
        let selected = Instant::now();
        self.select_time += selected - start;

        if rayon::current_num_threads() > 1 && self.live.len() > 1 {
            let actions = self.actions.par_chunks_exact(action_dim);
            self.live
                .par_iter_mut()
                .zip(actions)
                .try_for_each(|(episode, action)| episode.step(action))?;
        } else {
            let mut actions = self.actions.chunks_exact(action_dim);
            self.live
                .iter_mut()
                .zip(&mut actions)
                .try_for_each(|(episode, action)| episode.step(action))?;
        }
        self.environment_steps += self.live.len() as u64;
        self.collect_ended()?;
        self.physics_time += selected.elapsed();
        Ok(())
    }

    fn observe(&mut self) -> Result<(), EnvironmentError> {
        self.observations.clear();
        for episode in &self.live {
            let observation = episode.environment.observation();
            if observation.len() != self.sizes.0 {
                return Err(EnvironmentError::Observation {
                    found: observation.len(),
                    wanted: self.sizes.0,
                });
            }
            self.observations.extend(observation.iter().map(|&value| value as f32));
        }
        Ok(())
    }

    fn collect_ended(&mut self) -> Result<(), EnvironmentError> {
        for row in (0..self.live.len()).rev() {
            if self.live[row].ended {
                let Episode { mut environment, index, seed, episode_return, length, .. } =
                    self.live.swap_remove(row);
                self.states.swap_remove(row);
                let counted = |what, value| match EpisodeScore::counts(value) {
                    true => Ok(value),
                    false => Err(EnvironmentError::NotCounted { what, seed, value, length }),
                };
                let episode_return = counted("return", episode_return)?;
                let score = counted("score", environment.score(episode_return)?)?;
                self.outcomes.push(EpisodeOutcome { index, seed, episode_return, length, score });
            }
        }
        Ok(())
    }

    /// Whether every episode has ended.
    pub fn is_done(&self) -> bool {
        self.live.is_empty()
    }

    /// Episodes that have ended.
    pub fn episodes_done(&self) -> usize {
        self.outcomes.len()
    }

    /// Steps taken so far, summed over the episodes.
    pub fn environment_steps(&self) -> u64 {
        self.environment_steps
    }

    /// Time spent in the policy so far.
    pub fn select_time(&self) -> Duration {
        self.select_time
    }

    /// Time spent in the simulations so far.
    pub fn physics_time(&self) -> Duration {
        self.physics_time
    }

    /// The outcomes of the episodes that have ended, in the order of the seeds.
    pub fn into_outcomes(mut self) -> Vec<EpisodeOutcome> {
        self.outcomes.sort_unstable_by_key(|outcome| outcome.index);
        self.outcomes
    }
}

impl Episode {
    fn step(&mut self, action: &[f32]) -> Result<(), EnvironmentError> {
        let step = self.environment.step(action)?;
        self.episode_return += step.reward;
        self.length += 1;
        // A sum that is not finite stays so.
        self.ended = step.terminated || step.truncated || !self.episode_return.is_finite();
        Ok(())
    }
}
