//! The diffusion policy: the best of N_a candidates (Eq. 25), drawn from the target actor and valued by the target critics.

use crate::ensemble::Ensemble;
use crate::error::PolicyError;
use crate::noise_predictor::NoisePredictor;
use crate::policy::{ActionNoise, Cost, Policy, check_range};
use crate::precision::Precision;
use crate::schedule::Reverse;
use crate::shape::{EnsembleShape, MlpConfig, NoiseShape, tile_numbers};
use crate::slices::read;
use crate::weights::{Layout, Tensors, Weights};
use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};

/// Most denoising steps that are believed; the tensors' shapes do not bound them.
const MOST_STEPS: usize = 1000;
/// Before the names of the two networks' tensors.
const ACTOR: &str = "actor.";
const CRITIC: &str = "critic.";

/// The shapes of a diffusion policy's networks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DiffusionShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// The noise predictor's hidden layers.
    pub actor: MlpConfig,
    /// The critics' hidden layers.
    pub critic: MlpConfig,
    /// Ensemble size K.
    pub critics: usize,
    /// Denoising steps T.
    pub diffusion_steps: usize,
    /// How each of them is made when sampling.
    #[serde(default)]
    pub reverse: Reverse,
}

impl DiffusionShape {
    /// Of the noise predictor.
    pub fn actor(&self) -> NoiseShape {
        let Self { observation_dim, action_dim, diffusion_steps, reverse, .. } = *self;
        NoiseShape { observation_dim, action_dim, layers: self.actor.clone(), diffusion_steps, reverse }
    }

    /// Of the critics.
    pub fn critics(&self) -> EnsembleShape {
        let Self { observation_dim, action_dim, critics, .. } = *self;
        EnsembleShape { members: critics, observation_dim, action_dim, layers: self.critic.clone(), outputs: 1 }
    }

    fn check(&self) -> Result<(), PolicyError> {
        check_range("observation_dim", self.observation_dim)?;
        check_range("action_dim", self.action_dim)?;
        self.actor.check("actor.hidden")?;
        self.critic.check("critic.hidden")?;
        check_range("critics", self.critics)?;
        if self.diffusion_steps > MOST_STEPS {
            return Err(PolicyError::Range { field: "diffusion_steps", value: self.diffusion_steps });
        }
        check_range("diffusion_steps", self.diffusion_steps)
    }
}

/// Target actor and target critics.
pub struct DiffusionPolicy {
    shape: DiffusionShape,
    actor: NoisePredictor,
    critics: Ensemble,
}

/// Of some states: the chosen actions, `states × action_dim`; which candidates they are; and the ensemble-mean values of
/// all candidates, `states × candidates`.
type Choice = (Vec<f32>, Vec<usize>, Vec<f32>);

impl DiffusionPolicy {
    /// What it is called on the wire.
    pub const KIND: &str = "diffusion";

    /// The tensors of a policy of these networks, as they are named in a file.
    pub fn tensors(actor: &NoisePredictor, critics: &Ensemble) -> candle_core::Result<Tensors> {
        let mut tensors = actor.weights().tensors(ACTOR)?;
        tensors.extend(critics.weights().tensors(CRITIC)?);
        Ok(tensors)
    }

    pub(crate) fn load(
        shape: DiffusionShape,
        tensors: &mut Tensors,
        precision: Precision,
    ) -> Result<Self, PolicyError> {
        shape.check()?;
        let mut weights = |layout: Layout, prefix: &str| -> Result<Weights, PolicyError> {
            let values = layout.join(tensors, prefix)?;
            Ok(Weights::constant(layout, values))
        };
        let actor = NoisePredictor::new(shape.actor(), weights(shape.actor().layout(), ACTOR)?, precision);
        let critics = Ensemble::new(shape.critics(), weights(shape.critics().layout(), CRITIC)?, precision);
        Ok(Self { shape, actor, critics })
    }

    /// Draws candidates, with noise `T × states × candidates × action_dim`, and chooses the best. With one candidate the
    /// critics are not asked.
    pub(crate) fn choose(
        &self,
        observations: &[f32],
        candidates: usize,
        noise: Vec<f32>,
    ) -> Result<Choice, PolicyError> {
        let DiffusionShape { observation_dim, action_dim, critics, diffusion_steps, .. } = self.shape;
        let states = observations.len() / observation_dim;
        let rows = states * candidates;
        let observations = Tensor::from_slice(observations, (states, observation_dim), &Device::Cpu)?;
        let noise = Tensor::from_vec(noise, (diffusion_steps, rows, action_dim), &Device::Cpu)?;
        let drawn = self.actor.sample(&observations, &noise)?;
        let mut values = vec![0.0; rows];
        if candidates > 1 {
            read(&self.critics.values(&observations, &drawn)?, |each: &[f32]| {
                for critic in each.chunks_exact(rows) {
                    values.iter_mut().zip(critic).for_each(|(mean, q)| *mean += q / critics as f32);
                }
            })?;
        }
        let chosen = values.chunks_exact(candidates).map(best).collect::<Result<Vec<_>, _>>()?;
        let actions = read(&drawn, |drawn: &[f32]| {
            let row = |(i, chosen): (usize, &usize)| &drawn[(i * candidates + chosen) * action_dim..][..action_dim];
            chosen.iter().enumerate().flat_map(row).copied().collect::<Vec<f32>>()
        })?;
        Ok((actions, chosen, values))
    }
}

impl Policy for DiffusionPolicy {
    fn kind(&self) -> &'static str {
        Self::KIND
    }

    fn observation_dim(&self) -> usize {
        self.shape.observation_dim
    }

    fn action_dim(&self) -> usize {
        self.shape.action_dim
    }

    fn samples_candidates(&self) -> bool {
        true
    }

    fn cost(&self, states: usize, candidates: usize) -> Cost {
        let DiffusionShape { observation_dim, action_dim, diffusion_steps, .. } = self.shape;
        let (states, candidates, steps) = (states as u64, candidates as u64, diffusion_steps as u64);
        let rows = states.saturating_mul(candidates);
        // The noise of all steps, the candidates and their copies, and their values.
        let drawn = rows.saturating_mul(action_dim as u64).saturating_mul(steps + 3).saturating_add(rows);
        let observed = states.saturating_mul(observation_dim as u64);
        let sampling = drawn.saturating_add(observed).saturating_add(tile_numbers(candidates, &self.shape.actor));
        let critics = self.shape.critics().memory(states, candidates);
        Cost { bytes: sampling.saturating_mul(4).saturating_add(critics), products: 0 }
    }

    fn act(
        &self,
        observations: &[f32],
        candidates: usize,
        noise: &mut [ActionNoise],
        actions: &mut [f32],
    ) -> Result<(), PolicyError> {
        let (n, steps) = (noise.len(), self.shape.diffusion_steps);
        let row = candidates * self.shape.action_dim;
        let mut draws = vec![0.0; steps * n * row];
        for (i, stream) in noise.iter_mut().enumerate() {
            for step in 0..steps {
                stream.fill(&mut draws[(step * n + i) * row..][..row]);
            }
        }
        actions.copy_from_slice(&self.choose(observations, candidates, draws)?.0);
        match actions.iter().any(|x| x.is_nan()) {
            true => Err(PolicyError::NotANumber("a sampled action")),
            false => Ok(()),
        }
    }
}

/// The place of the largest value, the first of equals.
fn best(values: &[f32]) -> Result<usize, PolicyError> {
    let mut best = 0;
    for (i, value) in values.iter().enumerate() {
        if value.is_nan() {
            return Err(PolicyError::NotANumber("the value of a candidate"));
        }
        if *value > values[best] {
            best = i;
        }
    }
    Ok(best)
}
