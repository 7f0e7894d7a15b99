//! The flow actor (Park, Li and Levine 2025, "Flow Q-Learning"): candidates follow a velocity from
//! noise to actions.

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
    flow.outputs(observations, &Tensor::cat(&[x, t], 1)?)?.squeeze(0)
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

#[cfg(test)]
mod tests {
    use crate::error::PolicyError;
    use crate::file::PolicyConfig;
    use crate::policy::Samples;
    use crate::sampling::choice::Choice;
    use crate::testing::{act, argmax, file_of, load, of_two_units, sample, without_tensors};

    fn config(flow_steps: usize) -> PolicyConfig {
        PolicyConfig::Flow { shape: of_two_units(1), flow_steps, choice: Choice::best_of(50) }
    }

    #[test]
    fn actions_are_where_the_flow_leads() {
        // The velocity is s + t; the critics are a and 2a. Kernels, then biases, layer after layer.
        let actor = vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0];
        let first = [0.0, 0.0, 1.0, -1.0].repeat(2);
        let critics = [&first[..], &[0.0; 4], &[1.0, -1.0, 2.0, -2.0], &[0.0; 2]].concat();
        let mut weights = [actor, critics].into_iter();
        let policy = load(&file_of(config(4), None, |_| weights.next().unwrap())).unwrap();

        let Samples { actions, values } = sample(&*policy, &[0.25], &[3]).unwrap();
        let mut noise = vec![0.0; 50];
        policy.begin(3).fill_normal(&mut noise);
        for ((action, value), noise) in actions.iter().zip(&values).zip(noise) {
            let expected = (noise + 0.25 + (0.0 + 0.25 + 0.5 + 0.75) / 4.0).clamp(-1.0, 1.0);
            assert!((action - expected).abs() < 1e-6, "{action} for {expected}");
            assert!((value - 1.5 * expected).abs() < 1e-6, "{value}");
        }
        assert_eq!(act(&*policy, &[0.25], &[3]).unwrap(), [actions[argmax(&values)]]);
    }

    #[test]
    fn a_number_of_steps_out_of_range_is_refused() {
        for steps in [0, 1001, usize::MAX] {
            let policy = load(&without_tensors(config(steps)));
            assert!(matches!(policy, Err(PolicyError::Range { .. })), "{steps}");
        }
    }
}
