//! States that a run's policy visits.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::tools::score::Subject;

/// Random stream of an episode's seed by which one of its states is chosen.
const CHOICE_STREAM: u64 = 6;

#[derive(Debug, Default)]
pub struct State {
    pub qpos: Vec<f64>,
    pub qvel: Vec<f64>,
    /// The goal's x and y, in a task that has one.
    pub goal: Option<Vec<f64>>,
    pub observation: Vec<f32>,
    /// Seeds of the rollouts of each action in it.
    pub rollouts: Vec<u64>,
}

impl State {
    /// Plays the episode of a seed. Each of the states in which the policy acts is kept with the same
    /// probability.
    pub fn visit(subject: &Subject, seed: u64) -> anyhow::Result<Self> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(CHOICE_STREAM);
        let (mut kept, mut visited) = (Self::default(), 0);
        subject.play(seed, subject.seed, |simulation, _| {
            visited += 1;
            if random.random_range(0..visited) == 0 {
                kept = Self {
                    qpos: simulation.qpos().to_vec(),
                    qvel: simulation.qvel().to_vec(),
                    goal: simulation.goal().map(<[f64]>::to_vec),
                    observation: simulation.observation().iter().map(|x| *x as f32).collect(),
                    rollouts: Vec::new(),
                };
            }
        })?;
        Ok(kept)
    }
}
