//! What a policy does in the states that its judgement needs: asked once for each, and kept.

use std::time::{Duration, Instant};

use quad_dataset::Batch;
use quad_policy::Policy;
use rayon::prelude::*;

use super::data::Data;
use super::subject::Subject;

/// States that are asked for at a time, unless they take too much memory.
const STATES: usize = 256;
/// Memory for them, bytes.
const MEMORY: u64 = 1 << 28;
/// Seeds of the actions in judged episodes begin here, beyond those of the states to learn from.
const JUDGED: u64 = 1 << 32;

/// A policy's actions, in the evaluation's units.
pub(super) struct Actions {
    /// At the state after each transition to learn from, `[N, a]`.
    pub next: Vec<f32>,
    /// At the first state of each judged episode.
    pub first: Vec<f32>,
    /// At the states where it is compared with the data.
    pub at_states: Vec<f32>,
}

impl Actions {
    /// Asks the policy.
    ///
    /// # Errors
    /// It cannot act in these states.
    pub fn of(subject: &Subject, data: &Data) -> anyhow::Result<Self> {
        let mut after = Batch::default();
        data.training.gather(&Vec::from_iter(0..data.training.len() as u32), &mut after);
        Ok(Self {
            next: act(subject, data, &after.next_observations, 0)?,
            first: act(subject, data, &data.first.observations, JUDGED)?,
            at_states: act(subject, data, &data.compared.observations, 2 * JUDGED)?,
        })
    }

    /// How long that will take, by a few states.
    ///
    /// # Errors
    /// It cannot act in these states.
    pub fn time(subject: &Subject, data: &Data) -> anyhow::Result<Duration> {
        let width = data.training.observation_dim();
        let all = data.training.len() + data.first.size + data.compared.size;
        let count = data.compared.size.min(STATES);
        let begin = Instant::now();
        act(subject, data, &data.compared.observations[..count * width], 0)?;
        Ok(begin.elapsed().mul_f64(all as f64 / count as f64))
    }
}

/// Acts in these states, given in the evaluation's units. Each has a seed of its own, from `seed` on.
fn act(subject: &Subject, data: &Data, observations: &[f32], seed: u64) -> anyhow::Result<Vec<f32>> {
    let (policy, scaling) = (&*subject.policy, data.training.scaling());
    let (o, a) = (policy.observation_dim(), policy.action_dim());
    let mut observations = observations.to_vec();
    scaling.observations.iter().for_each(|affine| affine.to_user(&mut observations));
    let states = states_at_a_time(policy);
    let mut actions = vec![0.0; observations.len() / o * a];
    let parts = observations.par_chunks(states * o).zip(actions.par_chunks_mut(states * a)).enumerate();
    parts.try_for_each(|(part, (observations, actions))| {
        let first = seed + (part * states) as u64;
        let mut carried = Vec::from_iter((first..).take(observations.len() / o).map(|seed| policy.begin(seed)));
        policy.act(observations, &mut carried, actions)
    })?;
    scaling.actions.iter().for_each(|affine| affine.to_network(&mut actions));
    actions.iter_mut().for_each(|action| *action = action.clamp(-1.0, 1.0));
    Ok(actions)
}

fn states_at_a_time(policy: &dyn Policy) -> usize {
    let mut states = STATES;
    while states > 1 && policy.memory(states) > MEMORY {
        states /= 2;
    }
    states
}
