//! States that a run's policy visits.

use anyhow::Context;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::sim;
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
}

impl State {
    /// Plays the episode of a seed. Each of the states in which the policy acts is kept with the same
    /// probability.
    pub fn visit(subject: &Subject, seed: u64) -> anyhow::Result<Self> {
        let policy = &*subject.policy;
        let mut simulation = sim::make(subject.spec, subject.seed)?;
        simulation.reset(seed);
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(CHOICE_STREAM);
        let (mut memory, mut action) = ([policy.begin(seed)], vec![0.0; policy.action_dim()]);
        let (mut kept, mut visited) = (Self::default(), 1);
        loop {
            let state = Self {
                qpos: simulation.qpos().to_vec(),
                qvel: simulation.qvel().to_vec(),
                goal: simulation.goal().map(<[f64]>::to_vec),
                observation: simulation.observation().iter().map(|x| *x as f32).collect(),
            };
            let acted = policy.act(&state.observation, &mut memory, &mut action);
            acted.with_context(|| format!("{}: the policy cannot act", subject.path.display()))?;
            if random.random_range(0..visited) == 0 {
                kept = state;
            }
            visited += 1;
            let step = simulation.step(&action);
            if step.terminated || step.truncated {
                return Ok(kept);
            }
        }
    }
}
