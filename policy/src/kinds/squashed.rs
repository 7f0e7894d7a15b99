//! The squashed Gaussian policy: its candidates are tanh(u), where u is normal and a network of the
//! state gives its mean and log σ. Of these it takes one by what critics say of them.

use crate::kinds::actor_critic::ActorCriticShape;
use crate::sampling::candidates::Actor;
use candle_core::Tensor;
use quad_nn::{Ensemble, EnsembleShape};

/// A network that draws such candidates.
pub struct SquashedActor(Ensemble);

impl SquashedActor {
    /// Bounds of log σ.
    pub const LOG_STD: (f32, f32) = (-5.0, 2.0);

    /// Draws with a network of [`Self::shape`].
    pub fn new(network: Ensemble) -> Self {
        Self(network)
    }

    /// Shape of the network of which the mean comes first, then log σ.
    pub fn shape(of: &ActorCriticShape) -> EnsembleShape {
        let ActorCriticShape { observation_dim, action_dim, .. } = *of;
        EnsembleShape {
            members: 1,
            observation_dim,
            action_dim: 0,
            layers: of.actor.clone(),
            outputs: 2 * action_dim,
        }
    }

    /// Actions `[rows, a]` in the states of `observations`, `[n, o]`, with standard normal `noise`,
    /// `[rows, a]`; equally many consecutive rows share a state. No gradient flows through them.
    ///
    /// # Errors
    /// Shapes that do not fit, or candle fails.
    pub fn sample(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor> {
        let (rows, a) = noise.dims2()?;
        let out = self.0.state_outputs(observations)?.detach().transpose(0, 1)?; // [n, 1, 2a]
        let (mean, log_std) = (out.narrow(2, 0, a)?, out.narrow(2, a, a)?);
        let std = log_std.clamp(Self::LOG_STD.0, Self::LOG_STD.1)?.exp()?;
        let noise = noise.reshape((out.dim(0)?, (), a))?;
        noise.broadcast_mul(&std)?.broadcast_add(&mean)?.tanh()?.reshape((rows, a))
    }
}

impl Actor for SquashedActor {
    fn dims(&self) -> (usize, usize) {
        (self.0.shape().observation_dim, self.0.shape().outputs / 2)
    }

    fn noises(&self) -> usize {
        1
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor> {
        self.sample(observations, &noise.squeeze(0)?)
    }

    fn memory(&self, states: u128, candidates: u128) -> u128 {
        let shape = self.0.shape();
        // Mean and log σ on their way, and the normal numbers'.
        shape.memory(states, 1) + states * shape.outputs as u128 * (4 + candidates)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::error::PolicyError;
    use crate::file::{Header, PolicyConfig, load_policy};
    use crate::policy::{Policy, Sampled};
    use crate::sampling::choice::{Aggregate, Choice, Rule};
    use candle_core::Device;
    use quad_nn::{MlpConfig, Precision};

    const CHOICE: Choice = Choice {
        candidates: 3000,
        value: Aggregate::Min,
        rule: Rule::Softmax { temperature: f32::MIN_POSITIVE },
    };

    /// A policy whose mean is (0.5·s, −1) and whose log σ is (−1, what the state says times ten);
    /// both critics' value is a_0.
    fn policy() -> Box<dyn Policy> {
        let layers = MlpConfig { activation: crate::Activation::Relu, ..MlpConfig::mish(&[2]) };
        let shape = ActorCriticShape {
            observation_dim: 1,
            action_dim: 2,
            actor: layers.clone(),
            critic: layers,
            critics: 2,
        };
        let tensor = |numbers: &[f32], dims: &[usize]| {
            Tensor::from_slice(numbers, dims, &Device::Cpu).unwrap()
        };
        // relu(x) and relu(−x), put together again.
        let actor = [
            ("0.kernel", tensor(&[1.0, -1.0], &[1, 1, 2])),
            ("0.bias", tensor(&[0.0; 2], &[1, 2])),
            ("1.kernel", tensor(&[0.5, 0.0, 0.0, 10.0, -0.5, 0.0, 0.0, -10.0], &[1, 2, 4])),
            ("1.bias", tensor(&[0.0, -1.0, -1.0, 0.0], &[1, 4])),
        ];
        let critic = [
            ("0.kernel", tensor(&[0.0, 0.0, 1.0, -1.0, 0.0, 0.0].repeat(2), &[2, 3, 2])),
            ("0.bias", tensor(&[0.0; 4], &[2, 2])),
            ("1.kernel", tensor(&[1.0, -1.0].repeat(2), &[2, 2, 1])),
            ("1.bias", tensor(&[0.0; 2], &[2, 1])),
        ];
        let named = |prefix: &str, tensors: [(&str, Tensor); 4]| {
            tensors.map(|(name, tensor)| (format!("{prefix}.{name}"), tensor))
        };
        let tensors = named("actor", actor).into_iter().chain(named("critic", critic)).collect();
        let policy = PolicyConfig::Squashed { shape, choice: CHOICE };
        let file = Header::new(policy, ()).to_safetensors(&tensors).unwrap();
        load_policy(&file, Precision::F32).unwrap()
    }

    /// Mean and deviation of atanh of every second action, from this one on.
    fn moments(actions: &[f32]) -> (f64, f64) {
        let u: Vec<f64> = actions.iter().step_by(2).map(|a| f64::from(*a).atanh()).collect();
        let mean = u.iter().sum::<f64>() / u.len() as f64;
        (mean, (u.iter().map(|u| (u - mean).powi(2)).sum::<f64>() / u.len() as f64).sqrt())
    }

    #[test]
    fn candidates_are_the_tanh_of_normal_numbers_whose_mean_and_deviation_the_state_gives() {
        let policy = policy();
        let begin = || [1, 2].map(|seed| policy.begin(seed));
        // In the first state log σ_1 is −4, in the second it would be 8.
        let observations = [-0.4, 0.8];
        let Sampled { actions, values } = policy.sample(&observations, &mut begin()).unwrap();
        assert_eq!((actions.len(), values.len()), (2 * 3000 * 2, 2 * 3000));
        let (first, second) = actions.split_at(6000);
        for (found, expected) in [
            (moments(first), (-0.2, (-1f64).exp())),
            (moments(&first[1..]), (-1.0, (-4f64).exp())),
            (moments(second), (0.4, (-1f64).exp())),
        ] {
            let near = |x: f64, y: f64| (x - y).abs() < 0.06 * expected.1;
            assert!(
                near(found.0, expected.0) && near(found.1, expected.1),
                "{found:?} for {expected:?}"
            );
        }
        // σ is e² at most: so 5.9 % lie within ±0.5. With e⁸ none would.
        let inside = second[1..].iter().step_by(2).filter(|a| a.abs() < 0.5).count();
        assert!((120..240).contains(&inside), "{inside}");

        // The critics say a_0, and the softmax is cold.
        let mut taken = [0.0; 4];
        policy.act(&observations, &mut begin(), &mut taken).unwrap();
        for (taken, drawn) in taken.chunks_exact(2).zip([first, second]) {
            let largest = drawn.iter().step_by(2).copied().fold(f32::NEG_INFINITY, f32::max);
            assert_eq!(taken[0], largest);
        }
        assert_eq!(policy.value(&[0.0; 2], &[0.25, 1.0, -0.5, 1.0]).unwrap(), [0.25, -0.5]);
    }

    #[test]
    fn it_chooses_as_it_is_asked_to() {
        let policy = policy();
        assert_eq!(policy.choice(), Some(CHOICE));
        let of_one = policy.with_choice(Choice::best_of(1)).unwrap();
        let mut action = [0.0; 2];
        of_one.act(&[0.0], &mut [of_one.begin(5)], &mut action).unwrap();
        let drawn = of_one.sample(&[0.0], &mut [of_one.begin(5)]).unwrap();
        assert_eq!(drawn.actions, action);
        let nearest = Choice { rule: Rule::Nearest, ..CHOICE };
        assert!(matches!(policy.with_choice(nearest), Err(PolicyError::NoValue)));
        let mut nothing = [0.0; 2];
        assert!(policy.act(&[f32::NAN], &mut [policy.begin(5)], &mut nothing).is_err());
    }
}
