//! What a policy does in the states that its judgment needs: asked once for each, and kept.

use std::time::{Duration, Instant};

use quad_dataset::Batch;
use quad_policy::{Policy, Scaling};
use rayon::prelude::*;

use super::data::Data;

/// States that are asked for at a time, unless they take too much memory.
const STATES: usize = 256;
/// Memory for them, bytes.
const MEMORY: u64 = 1 << 28;
/// Seeds of the actions in judged episodes begin here, beyond those of the states to learn from.
const JUDGED: u64 = 1 << 32;

/// A policy's actions.
pub(super) struct Actions {
    /// At the state after each transition to learn from, `[N, a]`, in the evaluation's units.
    pub next: Vec<f32>,
    /// At the first state of each judged episode, likewise.
    pub first: Vec<f32>,
    /// At the states where it is compared with the data, in the data's units.
    pub at_states: Vec<f32>,
}

impl Actions {
    /// Asks the policy.
    ///
    /// # Errors
    /// It cannot act in these states.
    pub fn of(policy: &dyn Policy, data: &Data) -> anyhow::Result<Self> {
        let scaling = data.training.scaling();
        let mut after = Batch::default();
        data.training.gather(&Vec::from_iter(0..data.training.len() as u32), &mut after);
        Ok(Self {
            next: to_evaluation(scaling, act(policy, scaling, &after.next_observations, 0)?),
            first: to_evaluation(scaling, act(policy, scaling, &data.first.observations, JUDGED)?),
            at_states: act(policy, scaling, &data.compared.observations, 2 * JUDGED)?,
        })
    }

    /// How long that will take, by a few states.
    ///
    /// # Errors
    /// It cannot act in these states.
    pub fn time(policy: &dyn Policy, data: &Data) -> anyhow::Result<Duration> {
        let width = data.training.observation_dim();
        let all = data.training.len() + data.first.size + data.compared.size;
        let count = data.compared.size.min(STATES);
        let begin = Instant::now();
        act(policy, data.training.scaling(), &data.compared.observations[..count * width], 0)?;
        Ok(begin.elapsed().mul_f64(all as f64 / count as f64))
    }
}

/// Acts in these states, given in the evaluation's units; the actions are in the data's. Each state
/// has a seed of its own, from `seed` on.
fn act(
    policy: &dyn Policy,
    scaling: &Scaling,
    observations: &[f32],
    seed: u64,
) -> anyhow::Result<Vec<f32>> {
    let (o, a) = (policy.observation_dim(), policy.action_dim());
    let mut observations = observations.to_vec();
    scaling.observations.iter().for_each(|affine| affine.to_user(&mut observations));
    let states = states_at_a_time(policy);
    let mut actions = vec![0.0; observations.len() / o * a];
    let parts =
        observations.par_chunks(states * o).zip(actions.par_chunks_mut(states * a)).enumerate();
    parts.try_for_each(|(part, (observations, actions))| {
        let first = seed + (part * states) as u64;
        let mut carried =
            Vec::from_iter((first..).take(observations.len() / o).map(|seed| policy.begin(seed)));
        policy.act(observations, &mut carried, actions)
    })?;
    Ok(actions)
}

/// Actions in the evaluation's units, of those in the data's.
fn to_evaluation(scaling: &Scaling, mut actions: Vec<f32>) -> Vec<f32> {
    scaling.actions.iter().for_each(|affine| affine.to_network(&mut actions));
    actions.iter_mut().for_each(|action| *action = action.clamp(-1.0, 1.0));
    actions
}

fn states_at_a_time(policy: &dyn Policy) -> usize {
    let mut states = STATES;
    while states > 1 && policy.memory(states) > MEMORY {
        states /= 2;
    }
    states
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use quad_policy::{Affine, EpisodeState, PolicyError, Precision};

    use super::*;

    /// Acts by what it observes.
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

        fn memory(&self, _states: usize) -> u64 {
            0
        }

        fn act(
            &self,
            observed: &[f32],
            _: &mut [EpisodeState],
            actions: &mut [f32],
        ) -> Result<(), PolicyError> {
            actions.copy_from_slice(observed);
            Ok(())
        }
    }

    #[test]
    fn a_policy_sees_and_gives_the_datas_units_and_the_evaluation_its_own() {
        let affine = |offset: [f32; 2], scale: [f32; 2]| {
            Some(Affine { offset: offset.into(), scale: scale.into() })
        };
        let scaling = Scaling {
            observations: affine([100.0, -3.0], [10.0, 2.0]),
            actions: affine([90.0, 0.0], [20.0, 1.0]),
            ..Scaling::default()
        };
        let actions = act(&Echo, &scaling, &[0.0, 0.0, -1.5, 2.0], 0).unwrap();
        assert_eq!(actions, [100.0, -3.0, 85.0, 1.0]);
        assert_eq!(to_evaluation(&scaling, actions), [0.5, -1.0, -0.25, 1.0]);
    }
}
