//! The actors of Flow Q-Learning (Park, Li and Levine 2025): candidates follow a velocity from noise
//! to actions, or are a network of state and noise.

use crate::kinds::actor_critic::ActorCriticShape;
use crate::sampling::candidates::Actor;
use candle_core::{Result, Tensor};
use quad_nn::{Ensemble, EnsembleShape};

/// v(s, x, t), `[rows, a]`, of positions x, `[rows, a]`, at times t from 0 to 1, `[rows, 1]`; the
/// first rows/n rows belong to the first of `observations`, `[n, o]`, and so on.
pub fn flow_velocity(
    flow: &Ensemble,
    observations: &Tensor,
    x: &Tensor,
    t: &Tensor,
) -> Result<Tensor> {
    let inputs = Tensor::cat(&[x, t], 1)?;
    flow.outputs(observations, &inputs)?.squeeze(0)
}

/// The actor of a flow.
pub struct FlowActor {
    flow: Ensemble,
    steps: usize,
}

impl FlowActor {
    /// Largest number of Euler steps, which the tensors' shapes do not bound.
    pub(crate) const MOST_STEPS: usize = 1000;

    /// An actor of this many Euler steps with a network of [`Self::shape`].
    pub fn new(flow: Ensemble, steps: usize) -> Self {
        Self { flow, steps }
    }

    /// Shape of the velocity, a network of the state and of position and time, \[x, t\].
    pub fn shape(policy: &ActorCriticShape) -> EnsembleShape {
        let dims = (policy.observation_dim, policy.action_dim + 1);
        EnsembleShape::critics(1, dims, &policy.actor).with_outputs(policy.action_dim)
    }

    /// Actions `[rows, a]`, clipped to ±1, from standard normal `noise`, `[rows, a]`, for
    /// `observations`, `[n, o]`. The first rows/n rows belong to the first observation, and so on.
    pub fn sample(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let mut x = noise.clone();
        for step in 0..self.steps {
            let (t, rows) = (step as f32 / self.steps as f32, noise.dim(0)?);
            let t = Tensor::full(t, (rows, 1), noise.device())?;
            let velocity = flow_velocity(&self.flow, observations, &x, &t)?;
            x = (x + (velocity / self.steps as f64)?)?;
        }
        x.clamp(-1f32, 1f32)
    }
}

impl Actor for FlowActor {
    fn dims(&self) -> (usize, usize) {
        (self.flow.shape().observation_dim, self.flow.shape().outputs)
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        self.sample(observations, &noise.squeeze(0)?)
    }

    fn floats(&self, states: u128, candidates: u128) -> u128 {
        let shape = self.flow.shape();
        // Positions and velocities, before and after a step, and positions beside their times.
        shape.floats(states, candidates) + states * candidates * 6 * shape.action_dim as u128
    }
}

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
        let outputs = self.0.outputs(observations, noise)?;
        outputs.squeeze(0)?.clamp(-1f32, 1f32)
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
    use crate::error::PolicyError;
    use crate::file::PolicyConfig;
    use crate::policy::Samples;
    use crate::sampling::choice::Choice;
    use crate::testing::{act, argmax, load, sample, two_units, with_weights, without_tensors};

    const CHOICE: Choice = Choice::best_of(500);

    fn flow(flow_steps: usize) -> PolicyConfig {
        PolicyConfig::Flow { shape: two_units(1), flow_steps, choice: CHOICE }
    }

    #[test]
    fn actions_are_the_ends_of_the_flow_or_clipped_outputs() {
        // The velocity is s + t, the network of state and noise s + z. Kernels, then biases.
        let velocity = vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0];
        let output = vec![1.0, -1.0, 1.0, -1.0, 0.0, 0.0, 1.0, -1.0, 0.0];
        let (shape, choice) = (two_units(1), CHOICE);
        let one_step = PolicyConfig::OneStep { shape, choice };
        let shift = 0.25 + (0.0 + 0.25 + 0.5 + 0.75) / 4.0;
        for (config, actor, shift) in [(flow(4), velocity, shift), (one_step, output, 0.25)] {
            // The critics are a and 2a.
            let first = [0.0, 0.0, 1.0, -1.0].repeat(2);
            let critics = [&first[..], &[0.0; 4], &[1.0, -1.0, 2.0, -2.0], &[0.0; 2]].concat();
            let policy = load(&with_weights(config, vec![actor, critics])).unwrap();

            let Samples { actions, values } = sample(&*policy, &[0.25], &[3]).unwrap();
            let mut noise = vec![0.0; 500];
            policy.begin(3).fill_normal(&mut noise);
            for ((action, value), noise) in actions.iter().zip(&values).zip(noise) {
                let expected = (noise + shift).clamp(-1.0, 1.0);
                assert!((action - expected).abs() < 1e-6, "{action} for {expected}");
                assert!((value - 1.5 * expected).abs() < 1e-6, "{value}");
            }
            let best = act(&*policy, &[0.25], &[3]).unwrap();
            assert_eq!(best, [1.0], "the best of many is clipped");
            assert_eq!(best[0], actions[argmax(&values)]);
        }
    }

    #[test]
    fn a_number_of_steps_out_of_range_is_refused() {
        for steps in [0, 1001, usize::MAX] {
            let policy = load(&without_tensors(flow(steps)));
            assert!(matches!(policy, Err(PolicyError::Range { .. })), "{steps}");
        }
    }
}
