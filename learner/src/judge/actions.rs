//! The actions of a policy in all states that its judgment needs.

use std::time::{Duration, Instant};

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
    pub fn of(policy: &dyn Policy, data: &Data) -> anyhow::Result<Self> {
        let scaling = data.training.scaling();
        let all = data.training.gather(&Vec::from_iter(0..data.training.len() as u32));
        let next = act(policy, scaling, &all.next_observations, 0)?;
        let first = act(policy, scaling, &data.first.observations, JUDGED)?;
        let compared = act(policy, scaling, &data.compared.observations, 2 * JUDGED)?;
        Ok(Self { next: scaled(scaling, next), first: scaled(scaling, first), compared })
    }

    /// Estimates how long [`Self::of`] takes, by a few states.
    pub fn time(policy: &dyn Policy, data: &Data) -> anyhow::Result<Duration> {
        let all = data.training.len() + data.first.rewards.len() + data.compared.rewards.len();
        let timed = data.compared.rewards.len().min(STATES);
        let observations = &data.compared.observations[..timed * policy.observation_dim()];
        let begin = Instant::now();
        act(policy, data.training.scaling(), observations, 0)?;
        Ok(begin.elapsed().mul_f64(all as f64 / timed as f64))
    }
}

/// Actions `[n, a]` in the data's units, at scaled observations `[n, o]`. State i has seed + i.
fn act(
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
fn scaled(scaling: &Scaling, mut actions: Vec<f32>) -> Vec<f32> {
    if let Some(affine) = &scaling.actions {
        affine.to_network(&mut actions);
    }
    actions.into_iter().map(|action| action.clamp(-1.0, 1.0)).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use quad_dataset::{Arrays, Split, Transitions};
    use quad_policy::{Affine, EpisodeState, PolicyError, Precision};

    use super::*;

    struct Echo;

    impl Policy for Echo {
        fn observation_dim(&self) -> usize {
            2
        }

        fn action_dim(&self) -> usize {
            2
        }

        fn precision(&self) -> Precision {
            Precision::F32
        }

        fn memory(&self, _: usize) -> u64 {
            0
        }

        fn act(
            &self,
            observations: &[f32],
            _: &mut [EpisodeState],
            actions: &mut [f32],
        ) -> Result<(), PolicyError> {
            actions.copy_from_slice(observations);
            Ok(())
        }
    }

    #[test]
    fn a_policy_acts_in_the_states_that_each_use_needs() {
        let transitions = |offset: f32| {
            let states =
                |from: usize| (from..from + 8).map(|i| (offset + i as f32) / 20.0).collect();
            let actions = vec![0.0; 8];
            Transitions::of(Arrays {
                observation_dim: 2,
                action_dim: 2,
                observations: states(0),
                actions,
                rewards: vec![1.0; 4],
                next_observations: states(2),
                terminals: vec![false, false, false, true],
                timeouts: vec![false; 4],
            })
            .unwrap()
        };
        let (training, held_out) = (transitions(0.0), Some(transitions(10.0)));
        let split = Split { training, held_out, episodes: vec![1] };
        let data = Data::of(split, String::new(), String::new()).unwrap();
        let actions = Actions::of(&Echo, &data).unwrap();
        assert_eq!(actions.next, [0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45]);
        assert_eq!(actions.first, [0.5, 0.55]);
        assert_eq!(actions.compared, [0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85]);
    }

    #[test]
    fn policies_act_in_the_datas_units() {
        let affine = |offset: [f32; 2], scale: [f32; 2]| {
            let (offset, scale) = (offset.into(), scale.into());
            Some(Affine { offset, scale })
        };
        let scaling = Scaling {
            observations: affine([100.0, -3.0], [10.0, 2.0]),
            actions: affine([90.0, 0.0], [20.0, 1.0]),
            ..Scaling::default()
        };
        let actions = act(&Echo, &scaling, &[0.0, 0.0, -1.5, 2.0], 0).unwrap();
        assert_eq!(actions, [100.0, -3.0, 85.0, 1.0]);
        assert_eq!(scaled(&scaling, actions), [0.5, -1.0, -0.25, 1.0]);
    }
}
