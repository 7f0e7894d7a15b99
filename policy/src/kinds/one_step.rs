//! The one-step policy (Park, Li and Levine 2025, "Flow Q-Learning"): a network of state and noise
//! gives an action at once. Of several such candidates it takes one by what critics say of them.

use crate::kinds::actor_critic::ActorCriticShape;
use crate::sampling::candidates::Actor;
use candle_core::{Result, Tensor};
use quad_nn::{Ensemble, EnsembleShape};

/// A network that draws such candidates.
pub struct OneStepActor(Ensemble);

impl OneStepActor {
    /// Draws with a network of [`Self::shape`].
    pub fn new(network: Ensemble) -> Self {
        Self(network)
    }

    /// Shape of the network over state and noise, which is as long as an action.
    pub fn shape(of: &ActorCriticShape) -> EnsembleShape {
        let ActorCriticShape { observation_dim, action_dim, .. } = *of;
        EnsembleShape {
            members: 1,
            observation_dim,
            action_dim,
            layers: of.actor.clone(),
            outputs: action_dim,
        }
    }

    /// Actions `[rows, a]` in the states of `observations`, `[n, o]`, with standard normal `noise`,
    /// `[rows, a]`; equally many consecutive rows share a state. What is beyond ±1 is ±1.
    ///
    /// # Errors
    /// Shapes that do not fit, or candle fails.
    pub fn sample(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        self.0.outputs(observations, noise)?.squeeze(0)?.clamp(-1f32, 1f32)
    }
}

impl Actor for OneStepActor {
    fn dims(&self) -> (usize, usize) {
        (self.0.shape().observation_dim, self.0.shape().action_dim)
    }

    fn noises(&self) -> usize {
        1
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        self.sample(observations, &noise.squeeze(0)?)
    }

    fn memory(&self, states: u128, candidates: u128) -> u128 {
        let shape = self.0.shape();
        shape.memory(states, candidates) + states * candidates * shape.outputs as u128
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::file::{Header, PolicyConfig, load_policy};
    use crate::policy::Sampled;
    use crate::sampling::choice::Choice;
    use candle_core::Device;
    use quad_nn::{MlpConfig, Precision};

    #[test]
    fn an_action_is_what_the_network_says_of_state_and_noise_within_bounds() {
        let layers = MlpConfig { activation: crate::Activation::Relu, ..MlpConfig::mish(&[2]) };
        let shape = ActorCriticShape {
            observation_dim: 1,
            action_dim: 1,
            actor: layers.clone(),
            critic: layers,
            critics: 2,
        };
        // The actor gives s + z; the critics value an action by itself and by twice that.
        let tensor = |numbers: &[f32], dims: &[usize]| {
            Tensor::from_slice(numbers, dims, &Device::Cpu).unwrap()
        };
        let tensors = [
            ("actor.0.kernel", tensor(&[1.0, -1.0, 1.0, -1.0], &[1, 2, 2])),
            ("actor.0.bias", tensor(&[0.0; 2], &[1, 2])),
            ("actor.1.kernel", tensor(&[1.0, -1.0], &[1, 2, 1])),
            ("actor.1.bias", tensor(&[0.0], &[1, 1])),
            ("critic.0.kernel", tensor(&[0.0, 0.0, 1.0, -1.0].repeat(2), &[2, 2, 2])),
            ("critic.0.bias", tensor(&[0.0; 4], &[2, 2])),
            ("critic.1.kernel", tensor(&[1.0, -1.0, 2.0, -2.0], &[2, 2, 1])),
            ("critic.1.bias", tensor(&[0.0; 2], &[2, 1])),
        ];
        let tensors = tensors.map(|(name, tensor)| (name.to_owned(), tensor)).into();
        let policy = PolicyConfig::OneStep { shape, choice: Choice::best_of(500) };
        let file = Header::new(policy, ()).to_safetensors(&tensors).unwrap();
        let policy = load_policy(&file, Precision::F32).unwrap();

        let Sampled { actions, values } = policy.sample(&[0.25], &mut [policy.begin(3)]).unwrap();
        let mut noise = vec![0.0; 500];
        policy.begin(3).fill_normal(&mut noise);
        for ((action, value), noise) in actions.iter().zip(values).zip(noise) {
            let expected = (0.25 + noise).clamp(-1.0, 1.0);
            assert!(
                (action - expected).abs() < 1e-6 && (value - 1.5 * expected).abs() < 1e-6,
                "{action} {value}"
            );
        }
        let mut taken = [0.0];
        policy.act(&[0.25], &mut [policy.begin(3)], &mut taken).unwrap();
        assert_eq!(taken, [1.0], "the best of many is at the bound");
    }
}
