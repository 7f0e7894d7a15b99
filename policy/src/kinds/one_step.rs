//! The one-step actor (Park, Li and Levine 2025, "Flow Q-Learning"): candidates are a network of
//! state and noise.

use crate::kinds::actor_critic::ActorCriticShape;
use crate::sampling::candidates::Actor;
use candle_core::{Result, Tensor};
use quad_nn::{Ensemble, EnsembleShape};

/// The actor of a one-step policy.
pub struct OneStepActor(Ensemble);

impl OneStepActor {
    /// An actor with a network of [`Self::shape`].
    pub fn new(network: Ensemble) -> Self {
        Self(network)
    }

    /// Shape of the network of state and noise, which is as long as an action.
    pub fn shape(policy: &ActorCriticShape) -> EnsembleShape {
        let dims = (policy.observation_dim, policy.action_dim);
        EnsembleShape::critics(1, dims, &policy.actor).with_outputs(dims.1)
    }

    /// Actions `[rows, a]`, clipped to ±1, from standard normal `noise`, `[rows, a]`, for
    /// `observations`, `[n, o]`. The first rows/n rows belong to the first observation, and so on.
    pub fn sample(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        self.0.outputs(observations, noise)?.squeeze(0)?.clamp(-1f32, 1f32)
    }
}

impl Actor for OneStepActor {
    fn dims(&self) -> (usize, usize) {
        (self.0.shape().observation_dim, self.0.shape().action_dim)
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        self.sample(observations, &noise.squeeze(0)?)
    }

    fn floats(&self, states: u128, candidates: u128) -> u128 {
        let shape = self.0.shape();
        shape.floats(states, candidates) + states * candidates * shape.outputs as u128
    }
}

#[cfg(test)]
mod tests {
    use crate::file::PolicyConfig;
    use crate::policy::Samples;
    use crate::sampling::choice::Choice;
    use crate::testing::{act, file_of, load, of_two_units, sample};

    #[test]
    fn actions_are_a_clipped_network_of_state_and_noise() {
        // The actor is s + z; the critics are a and 2a. Kernels, then biases, layer after layer.
        let actor = vec![1.0, -1.0, 1.0, -1.0, 0.0, 0.0, 1.0, -1.0, 0.0];
        let first = [0.0, 0.0, 1.0, -1.0].repeat(2);
        let critics = [&first[..], &[0.0; 4], &[1.0, -1.0, 2.0, -2.0], &[0.0; 2]].concat();
        let mut weights = [actor, critics].into_iter();
        let (shape, choice) = (of_two_units(1), Choice::best_of(500));
        let policy = PolicyConfig::OneStep { shape, choice };
        let policy = load(&file_of(policy, None, |_| weights.next().unwrap())).unwrap();

        let Samples { actions, values } = sample(&*policy, &[0.25], &[3]).unwrap();
        let mut noise = vec![0.0; 500];
        policy.begin(3).fill_normal(&mut noise);
        for ((action, value), noise) in actions.iter().zip(values).zip(noise) {
            let expected = (0.25 + noise).clamp(-1.0, 1.0);
            assert!((action - expected).abs() < 1e-6, "{action} for {expected}");
            assert!((value - 1.5 * expected).abs() < 1e-6, "{value}");
        }
        let best = act(&*policy, &[0.25], &[3]).unwrap();
        assert_eq!(best, [1.0], "the best of many is clipped");
    }
}
