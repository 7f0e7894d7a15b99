//! SfBC's policy: candidates of a score network, chosen by a critic.

use crate::error::{Result, check_dims, check_range};
use crate::kinds::actor_critic::{ACTOR, CRITIC};
use crate::sampling::candidates::{Actor, CandidatePolicy, Networks};
use crate::sampling::choice::Choice;
use candle_core::Tensor;
use quad_nn::{
    DpmSolver, Ensemble, EnsembleShape, MlpConfig, Precision, ScoreNetwork, ScoreShape, Tensors,
    Weighted, Weights, take,
};
use serde::{Deserialize, Serialize};

/// Largest number of evaluations, which the tensors' shapes do not bound.
const MOST_EVALUATIONS: usize = 1000;
/// Name of the score network's frequencies.
pub(crate) const FREQUENCIES: &str = "frequencies";

/// The shapes of the networks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScorePolicyShape {
    /// Length of an observation s.
    pub observation_dim: usize,
    /// Length of an action a.
    pub action_dim: usize,
    /// Widths of the score network's downward blocks.
    pub actor: MlpConfig,
    /// The critic's hidden layers.
    pub critic: MlpConfig,
    /// Evaluations of the score network by the solver.
    pub evaluations: usize,
}

impl ScorePolicyShape {
    /// Shape of the score network.
    pub fn actor(&self) -> ScoreShape {
        ScoreShape {
            observation_dim: self.observation_dim,
            action_dim: self.action_dim,
            layers: self.actor.clone(),
        }
    }

    /// Shape of the critic, an ensemble of one.
    pub fn critic(&self) -> EnsembleShape {
        EnsembleShape::critics(1, (self.observation_dim, self.action_dim), &self.critic)
    }
}

/// The policy of SfBC.
pub struct ScorePolicy;

impl ScorePolicy {
    /// The tensors of a policy's file.
    pub fn tensors(actor: &ScoreNetwork, critic: &Ensemble) -> candle_core::Result<Tensors> {
        let mut tensors = actor.weights().tensors(ACTOR)?;
        tensors.extend(critic.weights().tensors(CRITIC)?);
        tensors.insert(FREQUENCIES.to_owned(), actor.frequencies().clone());
        Ok(tensors)
    }

    pub(crate) fn load(
        shape: &ScorePolicyShape,
        choice: Choice,
        tensors: &mut Tensors,
    ) -> Result<CandidatePolicy> {
        check_dims(shape.observation_dim, shape.action_dim)?;
        check_range("evaluations", shape.evaluations, MOST_EVALUATIONS)?;
        let frequencies = take(tensors, FREQUENCIES.to_owned(), &[ScoreShape::FREQUENCIES])?;
        let weights = Weights::take(shape.actor().layout(), tensors, ACTOR)?;
        let network = ScoreNetwork::new(shape.actor(), weights, frequencies, Precision::F32);
        let solver = DpmSolver::new(shape.evaluations);
        let precision = Precision::F32;
        let critic = Ensemble::take(shape.critic(), tensors, CRITIC, precision)?;
        let networks = Networks {
            actor: Box::new(ScoreActor { network, solver }),
            critics: Some(critic),
            value: None,
            precision,
        };
        CandidatePolicy::new(networks.into(), choice)
    }
}

struct ScoreActor {
    network: ScoreNetwork,
    solver: DpmSolver,
}

impl Actor for ScoreActor {
    fn dims(&self) -> (usize, usize) {
        let shape = self.network.shape();
        (shape.observation_dim, shape.action_dim)
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor> {
        let noise = noise.get(0)?;
        self.network.sample(&self.solver, observations, &noise)
    }

    fn floats(&self, states: u128, candidates: u128) -> u128 {
        let (shape, rows) = (self.network.shape(), states * candidates);
        // The solver holds six times the actions.
        shape.floats(states, rows) + rows * (6 * shape.action_dim) as u128
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::PolicyError;
    use crate::file::{PolicyConfig, load_policy};
    use crate::policy::Samples;
    use crate::sampling::choice::Aggregate;
    use crate::testing::{act, initial, layers, sample};
    use quad_nn::Activation;

    fn file(evaluations: usize, choice: Choice) -> Vec<u8> {
        let shape = ScorePolicyShape {
            observation_dim: 3,
            action_dim: 2,
            actor: layers(Activation::Silu, &[16, 8]),
            critic: layers(Activation::Silu, &[64; 2]),
            evaluations,
        };
        initial(PolicyConfig::Score { shape, choice })
    }

    /// The temperature is so low that the best four are certain.
    #[test]
    fn the_action_is_the_mean_of_the_best_candidates() {
        let rule = "average:1e-7:4".parse().unwrap();
        let file = file(5, Choice::new(6, Aggregate::Mean, rule));
        let [policy, exact] =
            [Precision::Bf16, Precision::F32].map(|asked| load_policy(&file, asked).unwrap());
        let (observations, seeds) = ([0.5, -0.2, 0.1, 1.0, 0.0, -1.0], [7, 8]);
        assert_eq!(policy.precision(), Precision::F32);
        let samples = sample(&*policy, &observations, &seeds).unwrap();
        assert_eq!(samples, sample(&*exact, &observations, &seeds).unwrap());
        let Samples { actions, values } = samples;
        let taken = act(&*policy, &observations, &seeds).unwrap();
        for (i, taken) in taken.chunks_exact(2).enumerate() {
            let (actions, values) = (&actions[i * 12..][..12], &values[i * 6..][..6]);
            let mut order: Vec<usize> = (0..6).collect();
            order.sort_by(|x, y| values[*y].total_cmp(&values[*x]));
            for (j, taken) in taken.iter().enumerate() {
                let chosen = order[..4].iter().map(|place| actions[place * 2 + j]);
                let mean = chosen.sum::<f32>() / 4.0;
                let error = (taken - mean).abs() / mean.abs().max(1.0);
                assert!(error < 1e-5, "state {i}: {taken} for {mean}");
            }
            let observations = observations[i * 3..][..3].repeat(6);
            assert_eq!(policy.value(&observations, actions).unwrap(), values);
        }
    }

    #[test]
    fn a_shape_out_of_range_is_refused() {
        for evaluations in [0, 1001, usize::MAX] {
            let policy = load_policy(&file(evaluations, Choice::best_of(1)), Precision::F32);
            assert!(matches!(policy, Err(PolicyError::Range { .. })));
        }
    }
}
