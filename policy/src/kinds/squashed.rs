//! The squashed Gaussian actor: candidates are tanh(u) with normal u, whose mean and log σ are a
//! network of the state.

use crate::kinds::actor_critic::ActorCriticShape;
use crate::sampling::candidates::Actor;
use candle_core::Tensor;
use quad_nn::{Ensemble, EnsembleShape};

/// The actor of a squashed Gaussian policy.
pub struct SquashedActor(Ensemble);

impl SquashedActor {
    /// Bounds of log σ.
    pub const LOG_STD: (f32, f32) = (-5.0, 2.0);

    /// An actor with a network of [`Self::shape`].
    pub fn new(network: Ensemble) -> Self {
        Self(network)
    }

    /// Shape of the network, which returns the mean, then log σ.
    pub fn shape(policy: &ActorCriticShape) -> EnsembleShape {
        EnsembleShape::state_network(policy.observation_dim, &policy.actor, 2 * policy.action_dim)
    }

    /// Actions `[rows, a]` from standard normal `noise`, `[rows, a]`, for `observations`, `[n, o]`,
    /// without gradients. The first rows/n rows belong to the first observation, and so on.
    pub fn sample(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor> {
        let (rows, a) = noise.dims2()?;
        let out = self.0.state_outputs(observations)?.detach();
        let out = out.transpose(0, 1)?; // [n, 1, 2a]
        let (mean, log_std) = (out.narrow(2, 0, a)?, out.narrow(2, a, a)?);
        let std = log_std.clamp(Self::LOG_STD.0, Self::LOG_STD.1)?.exp()?;
        let noise = noise.reshape((out.dim(0)?, (), a))?;
        let u = noise.broadcast_mul(&std)?.broadcast_add(&mean)?;
        u.tanh()?.reshape((rows, a))
    }
}

impl Actor for SquashedActor {
    fn dims(&self) -> (usize, usize) {
        (self.0.shape().observation_dim, self.0.shape().outputs / 2)
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor> {
        self.sample(observations, &noise.squeeze(0)?)
    }

    fn floats(&self, states: u128, candidates: u128) -> u128 {
        let shape = self.0.shape();
        // Mean and log σ of states, and those of candidates.
        shape.floats(states, 1) + states * shape.outputs as u128 * (4 + candidates)
    }
}

#[cfg(test)]
mod tests {
    use crate::error::PolicyError;
    use crate::file::PolicyConfig;
    use crate::policy::{Policy, Samples};
    use crate::sampling::choice::{Aggregate, Choice, Rule};
    use crate::sampling::episode::EpisodeState;
    use crate::testing::{load, two_units, with_weights};

    const CHOICE: Choice = Choice::new(2, Aggregate::Min, Rule::softmax(f32::MIN_POSITIVE));

    /// A policy with the mean (s/2, −1) and log σ (−1, 10·s), whose critics' values are a_0.
    fn policy() -> Box<dyn Policy> {
        // relu(x) − relu(−x) = x; kernels of both critics, then biases, layer after layer.
        let first = [1.0, -1.0, 0.0, 0.0];
        let last = [0.5, 0.0, 0.0, 10.0, -0.5, 0.0, 0.0, -10.0];
        let actor = [&first[..], &last, &[0.0, -1.0, -1.0, 0.0]].concat();
        let first = [0.0, 0.0, 1.0, -1.0, 0.0, 0.0].repeat(2);
        let last = [1.0, -1.0, 1.0, -1.0];
        let critics = [&first[..], &[0.0; 4], &last, &[0.0; 2]].concat();
        let (shape, choice) = (two_units(2), CHOICE);
        let policy = PolicyConfig::Squashed { shape, choice };
        load(&with_weights(policy, vec![actor, critics])).unwrap()
    }

    /// log σ_1 is −4, then clipped to 2 and to −5.
    #[test]
    fn candidates_are_tanh_of_normal_numbers() {
        let policy = policy();
        let noise = [0.3, -0.2, 1.1, 0.05];
        for (state, log_std) in [(-0.4, -4.0), (0.8, 2.0), (-0.9, -5.0)] {
            let begin = || [EpisodeState::with_noise(noise.to_vec())];
            let Samples { actions, values } = policy.sample(&[state], &mut begin()).unwrap();
            let expected = noise.chunks(2).flat_map(|noise| {
                let u = state / 2.0 + noise[0] * (-1_f32).exp();
                [u.tanh(), (noise[1] * f32::exp(log_std) - 1.0).tanh()]
            });
            let error = actions.iter().zip(expected).map(|(x, y)| (x - y).abs());
            assert!(error.fold(0.0, f32::max) < 1e-6, "{actions:?}");
            assert_eq!(values, [actions[0], actions[2]]);
            // The cold softmax takes the largest a_0.
            let mut taken = [0.0; 2];
            policy.act(&[state], &mut begin(), &mut taken).unwrap();
            assert_eq!(taken, actions[2..]);
        }
        let values = policy.value(&[0.0; 2], &[0.25, 1.0, -0.5, 1.0]);
        assert_eq!(values.unwrap(), [0.25, -0.5]);
    }

    #[test]
    fn guidance_takes_a_diffusion_policy() {
        let policy = policy();
        assert_eq!(policy.choice(), Some(CHOICE));
        let mut guided = CHOICE;
        guided.guidance = 1.0;
        let guided = policy.with_choice(guided);
        assert!(matches!(guided, Err(PolicyError::NoGuidance)));
    }
}
