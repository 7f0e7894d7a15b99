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
        EnsembleShape::of_state(policy.observation_dim, &policy.actor, 2 * policy.action_dim)
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
    use crate::testing::{act, file_of, load, of_two_units, sample};

    const CHOICE: Choice = Choice {
        candidates: 3000,
        aggregate: Aggregate::Min,
        rule: Rule::Softmax { temperature: f32::MIN_POSITIVE },
        guidance: 0.0,
    };

    /// A policy with the mean (s/2, −1) and log σ (−1, 10·s), whose critics' values are a_0.
    fn policy() -> Box<dyn Policy> {
        // relu(x) − relu(−x) = x; kernels of both critics, then biases, layer after layer.
        let first = [1.0, -1.0, 0.0, 0.0];
        let last = [0.5, 0.0, 0.0, 10.0, -0.5, 0.0, 0.0, -10.0];
        let actor = [&first[..], &last, &[0.0, -1.0, -1.0, 0.0]].concat();
        let first = [0.0, 0.0, 1.0, -1.0, 0.0, 0.0].repeat(2);
        let last = [1.0, -1.0, 1.0, -1.0];
        let critics = [&first[..], &[0.0; 4], &last, &[0.0; 2]].concat();
        let mut weights = [actor, critics].into_iter();
        let (shape, choice) = (of_two_units(2), CHOICE);
        let policy = PolicyConfig::Squashed { shape, choice };
        load(&file_of(policy, None, |_| weights.next().unwrap())).unwrap()
    }

    #[test]
    fn candidates_are_tanh_of_normal_numbers() {
        // Mean and standard deviation of atanh of every second action.
        let moments = |actions: &[f32]| {
            let actions = actions.iter().step_by(2);
            let u: Vec<f64> = actions.map(|a| f64::from(*a).atanh()).collect();
            let mean = u.iter().sum::<f64>() / u.len() as f64;
            let variance = u.iter().map(|u| (u - mean).powi(2)).sum::<f64>() / u.len() as f64;
            (mean, variance.sqrt())
        };
        let policy = policy();
        // In the first state log σ_1 is −4, in the second it would be 8.
        let (observations, seeds) = ([-0.4, 0.8], [1, 2]);
        let Samples { actions, values } = sample(&*policy, &observations, &seeds).unwrap();
        assert_eq!((actions.len(), values.len()), (2 * 3000 * 2, 2 * 3000));
        let (first, second) = actions.split_at(6000);
        for (found, expected) in [
            (moments(first), (-0.2, (-1f64).exp())),
            (moments(&first[1..]), (-1.0, (-4f64).exp())),
            (moments(second), (0.4, (-1f64).exp())),
        ] {
            let near = |x: f64, y: f64| (x - y).abs() < 0.06 * expected.1;
            let near = near(found.0, expected.0) && near(found.1, expected.1);
            assert!(near, "{found:?} for {expected:?}");
        }
        // σ is clamped to e², so that 5.9 % are within ±0.5.
        let log_std_1 = second[1..].iter().step_by(2);
        let inside = log_std_1.filter(|a| a.abs() < 0.5).count();
        assert!((120..240).contains(&inside), "{inside}");
        // The cold softmax takes the largest a_0.
        let taken = act(&*policy, &observations, &seeds).unwrap();
        for (taken, drawn) in taken.chunks_exact(2).zip([first, second]) {
            assert!(drawn.contains(&taken[0]));
            assert!(drawn.iter().step_by(2).all(|a| *a <= taken[0]));
        }
        assert_eq!(policy.value(&[0.0; 2], &[0.25, 1.0, -0.5, 1.0]).unwrap(), [0.25, -0.5]);
    }

    #[test]
    fn another_choice_applies() {
        let policy = policy();
        assert_eq!(policy.choice(), Some(CHOICE));
        let of_one = policy.with_choice(Choice::best_of(1)).unwrap();
        let drawn = sample(&*of_one, &[0.0], &[5]).unwrap();
        assert_eq!(act(&*of_one, &[0.0], &[5]).unwrap(), drawn.actions);
        let nearest = policy.with_choice(Choice::new(2, Aggregate::Min, Rule::Nearest));
        assert!(matches!(nearest, Err(PolicyError::NoValue)));
        let guided = policy.with_choice(Choice { guidance: 1.0, ..CHOICE });
        assert!(matches!(guided, Err(PolicyError::NoGuidance)));
        assert!(act(&*policy, &[f32::NAN], &[5]).is_err());
    }
}
