//! Diffusion Policy (Chi et al. 2023, "Diffusion Policy: Visuomotor Policy Learning via Action
//! Diffusion"): a diffusion policy that clones chunks of the data's actions, without critics. What
//! differs from its authors' code is in docs/deviations.md.

use super::diffusion::{Sampler, denoise, noise_predictor};
use super::prelude::*;
use quad_nn::{NoisePredictor, Reverse};
use quad_policy::{DiffusionPolicy, DiffusionShape};

pub(super) const DEFINITION: Definition = Definition {
    name: "diffusion-policy",
    presets: include_str!("../../presets/diffusion-policy.toml"),
    metrics: METRICS,
    chunks: true,
    read: |table| Ok(start(read(table)?, Cloning::new)),
    ..Definition::PLAIN
};

/// The EMA's rate after n updates is n^−`EMA_POWER`, and at least `LEAST_EMA_RATE`.
const EMA_POWER: f32 = 0.75;
const LEAST_EMA_RATE: f32 = 1e-4;

const METRICS: &[Metric] = &metrics! {
    bc_loss ["BC loss"] held_out: "Mean over batch and numbers of a chunk of (ε − ε_θ(a^t, s, t))² (Diffusion Policy's Eq. 5); beyond the end of an episode its last action is repeated. A network that always outputs 0 has loss 1.";
    learning_rate: "The learning rate; rises in the first updates, then falls to 0 along a cosine.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    diffusion_steps: Count,
    learning_rate: Positive,
    /// Updates in which the learning rate rises from 0.
    warmup: u64,
    /// Share of the learning rate by which each step shrinks the weights.
    weight_decay: NotNegative,
}

networks! {
    struct Networks(shape: &DiffusionShape, init) {
        /// ε_θ.
        actor: WithTarget<NoisePredictor> = noise_predictor(shape, init),
    }
}

struct Cloning {
    config: Config,
    context: Context,
    shape: DiffusionShape,
    networks: Networks,
}

impl Cloning {
    fn new(config: Config, context: Context) -> Result<Self> {
        let shape = DiffusionShape {
            observation_dim: context.observation_dim(),
            action_dim: context.action_dim(),
            actor: config.actor.clone(),
            critic: config.actor.clone(), // of no critics
            diffusion_steps: *config.diffusion_steps,
            reverse: Reverse::Cosine,
            ..DiffusionShape::default()
        };
        let mut networks = Networks::new(&shape, &mut Initializer::new(&context))?;
        networks.actor.decay_weights(*config.weight_decay)?;
        Ok(Self { config, context, shape, networks })
    }

    /// Copies of an episode's last action are learned, too: they may be executed.
    fn loss(&self, step: u64, batch: &Batch) -> Result<Loss> {
        let mut batch = batch.clone();
        batch.within = None;
        let (random, batch_size) = (self.context.random(step), batch.size());
        let (actor, shape) = (&self.networks.actor, &self.shape);
        let noise = Sampler { random, batch_size, shape, actor }.denoising()?;
        let (_, predicted) = denoise(actor, &batch, &noise)?;
        let loss = squared_error(&predicted, &noise.epsilon)?;
        Ok(Loss::new("bc_loss", loss))
    }

    fn learning_rate(&self, step: u64) -> f32 {
        let warmup = self.config.warmup;
        let share = match step.checked_sub(warmup) {
            None => step as f32 / warmup as f32,
            Some(after) => cosine_decay(after, self.context.total_steps.saturating_sub(warmup)),
        };
        *self.config.learning_rate * share
    }
}

impl Algorithm for Cloning {
    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let (loss, rate) = (self.loss(step, batch)?, self.learning_rate(step));
        let actor = &mut self.networks.actor;
        actor.minimize(&loss.value, AdamStep::after(step, rate))?;
        let ema_rate = (step.max(1) as f32).powf(-EMA_POWER);
        actor.soft_update(ema_rate.max(LEAST_EMA_RATE))?;
        let mut measured = measured(&[loss])?;
        measured.push(("learning_rate", rate));
        Ok(measured)
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        measured(&[self.loss(step, batch)?])
    }

    /// The EMA's chunks as they are drawn.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let tensors = DiffusionPolicy::tensors(&self.networks.actor.target, None, None)?;
        let (shape, choice) = (self.shape.clone(), Choice::best_of(1));
        Ok((PolicyConfig::Diffusion { shape, choice }, tensors))
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks.state_dict()
    }
}
