//! SfBC's policy: candidates of a score network, chosen by a critic.

use crate::error::{PolicyError, check_range};
use crate::kinds::actor_critic::{ACTOR, CRITIC};
use crate::sampling::candidates::{Actor, CandidatePolicy, Networks};
use crate::sampling::choice::Choice;
use candle_core::Tensor;
use quad_nn::{
    DpmSolver, Ensemble, EnsembleShape, MAX_DIM, MlpConfig, Precision, ScoreNetwork, ScoreShape,
    Tensors, Weighted, Weights, take,
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
        let Self { observation_dim, action_dim, .. } = *self;
        ScoreShape { observation_dim, action_dim, layers: self.actor.clone() }
    }

    /// Shape of the critic, an ensemble of one.
    pub fn critic(&self) -> EnsembleShape {
        EnsembleShape::critics(1, (self.observation_dim, self.action_dim), &self.critic)
    }

    fn check(&self) -> Result<(), PolicyError> {
        check_range("observation_dim", self.observation_dim, MAX_DIM)?;
        check_range("action_dim", self.action_dim, MAX_DIM)?;
        check_range("evaluations", self.evaluations, MOST_EVALUATIONS)
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
        shape: ScorePolicyShape,
        choice: Choice,
        tensors: &mut Tensors,
        precision: Precision,
    ) -> Result<CandidatePolicy, PolicyError> {
        shape.check()?;
        let frequencies = take(tensors, FREQUENCIES.to_owned(), &[ScoreShape::FREQUENCIES])?;
        let weights = Weights::take(shape.actor().layout(), tensors, ACTOR)?;
        let network = ScoreNetwork::new(shape.actor(), weights, frequencies);
        let actor = Box::new(ScoreActor { network, solver: DpmSolver::new(shape.evaluations) });
        let critics = Ensemble::take(shape.critic(), tensors, CRITIC, precision)?;
        CandidatePolicy::new(Networks { actor, critics, value: None }, choice, Precision::F32)
    }
}

/// A score network and its solver.
struct ScoreActor {
    network: ScoreNetwork,
    solver: DpmSolver,
}

impl Actor for ScoreActor {
    fn dims(&self) -> (usize, usize) {
        (self.network.shape().observation_dim, self.network.shape().action_dim)
    }

    fn noise_vectors(&self) -> usize {
        1
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor> {
        self.network.sample(&self.solver, observations, &noise.get(0)?)
    }

    fn floats(&self, states: u128, candidates: u128) -> u128 {
        let (shape, rows) = (self.network.shape(), states * candidates);
        // The solver holds six times the actions.
        shape.floats(states, rows) + rows * (6 * shape.action_dim) as u128
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::file::{PolicyConfig, load_policy};
    use crate::policy::Samples;
    use crate::sampling::choice::Rule;
    use crate::testing::{act, initial, sample};
    use quad_nn::Activation;

    fn file(evaluations: usize, choice: Choice) -> Vec<u8> {
        let actor = MlpConfig { activation: Activation::Silu, ..MlpConfig::mish(&[16, 8]) };
        let (critic, dims) = (actor.clone(), (3, 2));
        let (observation_dim, action_dim) = dims;
        let shape = ScorePolicyShape { observation_dim, action_dim, actor, critic, evaluations };
        initial(PolicyConfig::Score { shape, choice })
    }

    /// The temperature is so low that the best four are certain.
    #[test]
    fn the_action_is_the_mean_of_the_best_candidates() {
        let rule = Rule::Average { temperature: 1e-7, actions: 4 };
        let file = file(5, Choice { rule, ..Choice::best_of(6) });
        let policy = load_policy(&file, Precision::Bf16).unwrap();
        assert_eq!(policy.precision(), Precision::F32);
        let (observations, seeds) = ([0.5, -0.2, 0.1, 1.0, 0.0, -1.0], [7, 8]);
        let Samples { actions, values } = sample(&*policy, &observations, &seeds).unwrap();
        let taken = act(&*policy, &observations, &seeds).unwrap();
        for (i, taken) in taken.chunks_exact(2).enumerate() {
            let (actions, values) = (&actions[i * 12..][..12], &values[i * 6..][..6]);
            let mut order: Vec<usize> = (0..6).collect();
            order.sort_by(|x, y| values[*y].total_cmp(&values[*x]));
            for (j, taken) in taken.iter().enumerate() {
                let mean = order[..4].iter().map(|place| actions[place * 2 + j]).sum::<f32>() / 4.0;
                let error = (taken - mean).abs() / mean.abs().max(1.0);
                assert!(error < 1e-5, "state {i}: {taken} for {mean}");
            }
            let observations = observations[i * 3..][..3].repeat(6);
            assert_eq!(policy.value(&observations, actions).unwrap(), values);
        }
        let nearest = Choice { rule: Rule::Nearest, ..Choice::best_of(2) };
        assert!(matches!(policy.with_choice(nearest), Err(PolicyError::NoValue)));
    }

    #[test]
    fn a_shape_out_of_range_is_refused() {
        for evaluations in [0, 1001, usize::MAX] {
            let policy = load_policy(&file(evaluations, Choice::best_of(1)), Precision::F32);
            assert!(matches!(policy, Err(PolicyError::Range { .. })), "{evaluations}");
        }
    }
}
