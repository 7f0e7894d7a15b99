//! The actions of a policy in all states that its judgment needs.

use quad_policy::{Policy, Scaling};
use rayon::prelude::*;

use super::data::Data;

/// States per call of a policy, fewer if they take more than [`MEMORY`].
const STATES: usize = 256;
/// Bytes.
const MEMORY: u64 = 1 << 28;
/// First seed of the actions in judged episodes, beyond those of the training states.
const JUDGED: u64 = 1 << 32;

pub(super) struct Actions {
    /// a' at the s' of each training transition, `[N, a]`, scaled.
    pub next: Vec<f32>,
    /// At the first state of each judged episode, `[episodes, a]`, scaled.
    pub first: Vec<f32>,
    /// At the compared states, `[states, a]`, in the data's units.
    pub compared: Vec<f32>,
}

impl Actions {
    pub fn new(policy: &dyn Policy, data: &Data) -> anyhow::Result<Self> {
        let scaling = data.training.scaling();
        let training = data.training.gather(&Vec::from_iter(0..data.training.len() as u32));
        let next = act(policy, scaling, &training.next_observations, 0)?;
        let first = act(policy, scaling, &data.first.observations, JUDGED)?;
        let compared = act(policy, scaling, &data.compared.observations, 2 * JUDGED)?;
        Ok(Self { next: scaled(scaling, next), first: scaled(scaling, first), compared })
    }
}

/// Actions `[n, a]` in the data's units, at scaled observations `[n, o]`. State i has seed + i.
pub(super) fn act(
    policy: &dyn Policy,
    scaling: &Scaling,
    observations: &[f32],
    seed: u64,
) -> anyhow::Result<Vec<f32>> {
    let (o, a) = (policy.observation_dim(), policy.action_dim());
    let mut observations = observations.to_vec();
    if let Some(affine) = &scaling.observations {
        affine.to_user(&mut observations);
    }
    let mut actions = vec![0.0; observations.len() / o * a];
    let mut states = STATES;
    while states > 1 && policy.memory(states) > MEMORY {
        states /= 2;
    }
    let chunks = actions.par_chunks_mut(states * a).enumerate();
    let chunks = chunks.zip(observations.par_chunks(states * o));
    chunks.try_for_each(|((chunk, actions), observations)| {
        let seeds = (seed + (chunk * states) as u64..).take(observations.len() / o);
        let mut episodes = Vec::from_iter(seeds.map(|seed| policy.begin(seed)));
        policy.act(observations, &mut episodes, actions)
    })?;
    Ok(actions)
}

/// From the data's units to [−1, 1].
pub(super) fn scaled(scaling: &Scaling, mut actions: Vec<f32>) -> Vec<f32> {
    if let Some(affine) = &scaling.actions {
        affine.to_network(&mut actions);
    }
    actions.into_iter().map(|action| action.clamp(-1.0, 1.0)).collect()
}
