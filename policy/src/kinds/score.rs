//! The policy of SfBC: it draws candidates by solving the reverse process of a cloned score
//! network, and takes some by what a critic says of them.

use crate::error::{PolicyError, check_range};
use crate::sampling::candidates::{Actor, CandidatePolicy, Networks};
use crate::sampling::choice::Choice;
use candle_core::Tensor;
use quad_nn::{
    DpmSolver, Ensemble, EnsembleShape, MAX_DIM, MlpConfig, Precision, ScoreNetwork, ScoreShape,
    Tensors, Weighted, Weights, take,
};
use serde::{Deserialize, Serialize};

/// Most evaluations that are believed; the tensors' shapes do not bound them.
const MOST_EVALUATIONS: usize = 1000;
/// Before the names of the networks' tensors, and the name of the score network's frequencies.
const ACTOR: &str = "actor.";
const CRITIC: &str = "critic.";
pub(crate) const FREQUENCIES: &str = "frequencies";

/// The shapes of such a policy's networks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScorePolicyShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// The score network's narrowing blocks.
    pub actor: MlpConfig,
    /// The critic's hidden layers.
    pub critic: MlpConfig,
    /// Evaluations of the score network for an action.
    pub evaluations: usize,
}

impl ScorePolicyShape {
    /// Shape of the score network.
    pub fn actor(&self) -> ScoreShape {
        let Self { observation_dim, action_dim, .. } = *self;
        ScoreShape { observation_dim, action_dim, layers: self.actor.clone() }
    }

    /// Shape of the critic, an ensemble of one.
    pub fn critic(&self) -> EnsembleShape {
        let Self { observation_dim, action_dim, .. } = *self;
        EnsembleShape {
            members: 1,
            observation_dim,
            action_dim,
            layers: self.critic.clone(),
            outputs: 1,
        }
    }

    fn check(&self) -> Result<(), PolicyError> {
        check_range("observation_dim", self.observation_dim, MAX_DIM)?;
        check_range("action_dim", self.action_dim, MAX_DIM)?;
        check_range("evaluations", self.evaluations, MOST_EVALUATIONS)
    }
}

/// The policy of a score network and a critic.
pub struct ScorePolicy;

impl ScorePolicy {
    /// The tensors of a policy of these networks, as they are named in a file.
    ///
    /// # Errors
    /// Candle fails.
    pub fn tensors(actor: &ScoreNetwork, critic: &Ensemble) -> candle_core::Result<Tensors> {
        let mut tensors = actor.weights().tensors(ACTOR)?;
        tensors.extend(critic.weights().tensors(CRITIC)?);
        tensors.insert(FREQUENCIES.to_owned(), actor.frequencies().clone());
        Ok(tensors)
    }

    pub(crate) fn load(
        shape: ScorePolicyShape,
        choice: Choice,
        tensors: &mut Tensors,
        precision: Precision,
    ) -> Result<CandidatePolicy, PolicyError> {
        shape.check()?;
        let frequencies = take(tensors, FREQUENCIES.to_owned(), &[ScoreShape::FREQUENCIES])?;
        let weights = Weights::take(shape.actor().layout(), tensors, ACTOR)?;
        let actor = Drawing {
            network: ScoreNetwork::new(shape.actor(), weights, frequencies),
            solver: DpmSolver::new(shape.evaluations),
        };
        let critics = Ensemble::take(shape.critic(), tensors, CRITIC, precision)?;
        CandidatePolicy::new(
            Networks { actor: Box::new(actor), critics, value: None },
            choice,
            Precision::F32,
        )
    }
}

/// A score network with what it is sampled by.
struct Drawing {
    network: ScoreNetwork,
    solver: DpmSolver,
}

impl Actor for Drawing {
    fn dims(&self) -> (usize, usize) {
        (self.network.shape().observation_dim, self.network.shape().action_dim)
    }

    fn noises(&self) -> usize {
        1
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor> {
        self.network.sample(&self.solver, observations, &noise.get(0)?)
    }

    fn memory(&self, states: u128, candidates: u128) -> u128 {
        // The solver holds some actions more.
        let shape = self.network.shape();
        shape.memory(states, states * candidates)
            + states * candidates * (6 * shape.action_dim) as u128
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::file::{Header, PolicyConfig, load_policy};
    use crate::policy::Sampled;
    use crate::sampling::choice::Rule;
    use candle_core::Device;
    use quad_kernels::activation::Activation;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn shape() -> ScorePolicyShape {
        let actor = MlpConfig { activation: Activation::Silu, ..MlpConfig::mish(&[16, 8]) };
        ScorePolicyShape {
            observation_dim: 3,
            action_dim: 2,
            critic: actor.clone(),
            actor,
            evaluations: 5,
        }
    }

    fn file(shape: &ScorePolicyShape, choice: Choice) -> Vec<u8> {
        let generator = &mut ChaCha8Rng::seed_from_u64(1);
        let actor = Weights::initial(&shape.actor().layout(), generator, &Device::Cpu).unwrap();
        let actor = Weights::constant(shape.actor().layout(), actor);
        let actor =
            ScoreNetwork::new(shape.actor(), actor, ScoreShape::frequencies(generator).unwrap());
        let critic = Weights::initial(&shape.critic().layout(), generator, &Device::Cpu).unwrap();
        let critic = Weights::constant(shape.critic().layout(), critic);
        let critic = Ensemble::new(shape.critic(), critic, Precision::F32);
        let policy = PolicyConfig::Score { shape: shape.clone(), choice };
        let tensors = ScorePolicy::tensors(&actor, &critic).unwrap();
        Header::new(policy, ()).to_safetensors(&tensors).unwrap()
    }

    /// The action is the mean of the best four candidates where the temperature leaves no doubt
    /// which these are.
    #[test]
    fn it_does_the_mean_of_the_best_of_what_it_samples() {
        let rule = Rule::Average { temperature: 1e-7, actions: 4 };
        let policy =
            load_policy(&file(&shape(), Choice { rule, ..Choice::best_of(6) }), Precision::Bf16)
                .unwrap();
        assert_eq!(policy.precision(), Precision::F32);
        let observations = [0.5, -0.2, 0.1, 1.0, 0.0, -1.0];
        let begin = || [7, 8].map(|seed| policy.begin(seed));
        let Sampled { actions, values } = policy.sample(&observations, &mut begin()).unwrap();
        let mut taken = [0.0; 4];
        policy.act(&observations, &mut begin(), &mut taken).unwrap();
        for (i, taken) in taken.chunks_exact(2).enumerate() {
            let (actions, values) = (&actions[i * 12..][..12], &values[i * 6..][..6]);
            let mut order: Vec<usize> = (0..6).collect();
            order.sort_by(|x, y| values[*y].total_cmp(&values[*x]));
            for (j, taken) in taken.iter().enumerate() {
                let mean = order[..4].iter().map(|place| actions[place * 2 + j]).sum::<f32>() / 4.0;
                assert!(
                    (taken - mean).abs() < 1e-5 * mean.abs().max(1.0),
                    "state {i}: {taken} for {mean}"
                );
            }
            assert_eq!(
                policy.value(&observations[i * 3..][..3].repeat(6), actions).unwrap(),
                values
            );
        }
        let nearest = Choice { rule: Rule::Nearest, ..Choice::best_of(2) };
        assert!(matches!(policy.with_choice(nearest), Err(PolicyError::NoValue)));
    }

    #[test]
    fn a_shape_out_of_range_is_refused() {
        for evaluations in [0, 1001, usize::MAX] {
            let file = file(&ScorePolicyShape { evaluations, ..shape() }, Choice::best_of(1));
            assert!(matches!(load_policy(&file, Precision::F32), Err(PolicyError::Range { .. })));
        }
    }
}
