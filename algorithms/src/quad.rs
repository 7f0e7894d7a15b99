//! QUAD (Algorithm 1 of the paper): a diffusion policy is cloned from the data and pulled along the
//! critics' gradients, as far as the critics agree on them. Equations are the paper's; where it is
//! silent, docs/deviations.md says what holds.

mod config;
mod guidance;
mod metrics;
mod noise;
mod summary;

use super::definition::Axis;
use super::diffusion::{Diffusion, DiffusionUpdate, Networks, Sampler, denoise};
use super::prelude::*;
use super::state_dict::write;
use config::{Config, Guidance, TargetReduce};
use guidance::{Averages, Guide};
use metrics::METRICS;
use noise::Noise;
use quad_nn::{Reverse, pulled_error};
use quad_policy::{DiffusionPolicy, DiffusionShape};

pub(super) const DEFINITION: Definition = Definition {
    name: "quad",
    presets: include_str!("../../presets/quad.toml"),
    metrics: METRICS,
    // DAC and behavior cloning (none) have names of their own.
    variant: Some(Variant { key: "guidance", called: str::to_owned, unused: config::unused }),
    axis: Some(Axis { key: "tau", symbol: "τ" }),
    acts_after: Some("actor_ema_start"),
    summary: Some(summary::summarize),
    chunks: true,
    needs_data: true,
    read: |table| Ok(start(Config::read(table)?, Quad::start)),
};

struct Quad {
    config: Config,
    /// Strength η of behavior cloning, `[]`.
    eta: Tensor,
    averages: Averages,
}

impl Quad {
    fn start(config: Config, context: Context) -> Result<Diffusion<Self>> {
        let shape = DiffusionShape {
            actor: config.actor.clone(),
            critic: config.critic.clone(),
            critics: *config.critics,
            diffusion_steps: *config.diffusion_steps,
            reverse: Reverse::ClipClean,
            ..DiffusionShape::default()
        };
        let eta = Tensor::new(*config.eta.initial, &context.device)?;
        let averages = Averages::new(&config, &context.device)?;
        let quad = Self { config, eta, averages };
        Diffusion::new(shape, context, |_, _| Ok(quad))
    }

    /// y = r + γ·mask·(mean − ρ·std over the critics of each one's value of s') (Eq. 20), `[B]`. A
    /// critic's value of s' is the mean, or the largest, of its values of the sampled actions.
    fn targets(&self, networks: &Networks, batch: &Batch, noise: &Tensor) -> Result<Tensor> {
        let next_actions = networks.sample_next(batch, noise)?;
        let q = batch.next_values(&networks.critic.target, &next_actions)?;
        let q = q.reshape((*self.config.critics, (), *self.config.samples))?;
        let value = match self.config.target_reduce {
            TargetReduce::Mean => q.mean(2)?,
            TargetReduce::Max => largest(&q, 2)?,
        };
        batch.target(*self.config.gamma, &lower_bound(&value, *self.config.rho)?)
    }

    /// Every critic toward the lower confidence bound (Eq. 20).
    fn critic_loss(&self, networks: &Networks, batch: &Batch, noise: &Noise) -> Result<Loss> {
        let targets = self.targets(networks, batch, &noise.next)?;
        batch.critic_loss(&networks.critic, &targets)
    }

    /// Behavior cloning (Eq. 6), pulled along the gradients that the critics agree on (Eq. 19).
    fn actor_loss(
        &self,
        networks: &Networks,
        batch: &Batch,
        noise: &Noise,
    ) -> Result<(Loss, Option<Guide>)> {
        let (noisy, predicted) = denoise(&networks.actor, batch, &noise.denoising)?;
        let error = (predicted.detach() - &noise.denoising.epsilon)?;
        let epsilon = &noise.denoising.epsilon;
        if self.config.guidance == Guidance::None {
            let bc_loss = squared_error(&predicted, epsilon)?;
            let loss = (&bc_loss * &self.eta)?;
            return Ok((Loss::new("actor_loss", loss).with("bc_loss", bc_loss), None));
        }
        let critics = &networks.critic.target;
        let noisy = (&noisy, &predicted.detach());
        let averages = &self.averages;
        let guide = averages.guide(&self.config, critics, batch, noise, noisy)?;
        let gradient = (&guide.gradient * &noise.denoising.deviation)?;
        let pull = gradient.broadcast_mul(&guide.lambda.unsqueeze(1)?)?;
        let (loss, bc_loss) = pulled_error(&predicted, epsilon, &self.eta, &pull)?;
        let mut loss = Loss::new("actor_loss", loss).with("bc_loss", bc_loss);
        loss.metric_inputs = metrics::lambda_inputs(&guide, error);
        let loss = loss.with("delta_share", guide.delta_share.clone());
        Ok((loss, Some(guide)))
    }

    /// η after a step of dual ascent: `excess` is how far the BC loss is above its threshold, `[]`.
    fn ascended_eta(&self, excess: Tensor) -> Result<Tensor> {
        let eta = &self.config.eta;
        let raised = (&self.eta + (excess.clamp(-1f32, 1f32)? * f64::from(*eta.rate))?)?;
        raised.clamp(*eta.minimum, *eta.maximum)
    }
}

impl DiffusionUpdate for Quad {
    type Noise = Noise;

    fn noise(&self, sampler: Sampler<'_>) -> Result<Noise> {
        Noise::draw(&self.config, sampler)
    }

    fn begin(&mut self, networks: &mut Networks, step: u64, context: &Context) -> Result<()> {
        let config = &self.config;
        let decay = context.decay(step, *config.online_rate);
        let clip = *config.gradient_clip;
        let adam = |rate: Positive| AdamStep::after(step, *rate * decay).clipped(clip);
        networks.set_steps([config.actor_learning_rate, config.critic_learning_rate].map(adam))
    }

    /// Algorithm 1's loop, but for the target actor.
    fn update(
        &mut self,
        networks: &mut Networks,
        batch: &Batch,
        noise: &Noise,
    ) -> Result<Vec<Loss>> {
        // Lines 4–7: the critics, and line 14: their EMA.
        let critic_loss = self.critic_loss(networks, batch, noise)?;
        let critic_norm = networks.critic.minimize_as_set(&critic_loss.value)?;
        networks.critic.soft_update(*self.config.ema_rate)?;

        // Lines 8–11: the actor.
        let (actor_loss, guide) = self.actor_loss(networks, batch, noise)?;
        let actor_norm = networks.actor.minimize_as_set(&actor_loss.value)?;

        if let Some(guide) = &guide {
            self.averages.set(&guide.averages)?;
            // Line 12: dual ascent on η, with the actor as it is now.
            if let Some(threshold) = self.config.eta.threshold {
                let (_, predicted) = denoise(&networks.actor.detach(), batch, &noise.denoising)?;
                let bc_loss = squared_error(&predicted, &noise.denoising.epsilon)?;
                let eta = self.ascended_eta((bc_loss - f64::from(*threshold))?)?;
                write(&self.eta, &eta)?;
            }
        }
        let nu_squared = guide.map(|_| self.averages.nu_squared.clone());
        Ok(vec![
            critic_loss.with("critic_gradient_norm", critic_norm),
            actor_loss
                .with("eta", self.eta.clone())
                .with("nu_squared", nu_squared)
                .with("actor_gradient_norm", actor_norm),
        ])
    }

    /// Line 13: the actor's EMA.
    fn end(&mut self, networks: &mut Networks, step: u64) -> Result<()> {
        if step.is_multiple_of(*self.config.actor_ema_every) && step > self.config.actor_ema_start {
            networks.actor.soft_update(*self.config.ema_rate)?;
        }
        Ok(())
    }

    fn losses(&self, networks: &Networks, batch: &Batch, noise: &Noise) -> Result<Vec<Loss>> {
        let (actor_loss, _) = self.actor_loss(networks, batch, noise)?;
        Ok(vec![self.critic_loss(networks, batch, noise)?, actor_loss])
    }

    fn measure(&self, networks: &Networks, noise: &Noise, numbers: &[f32]) -> Result<Measured> {
        let (steps, delta) = (*self.config.diffusion_steps, *self.config.delta);
        let t = noise.denoising.t.to_vec1()?;
        let mut measured = metrics::measure_lambda(numbers, &t, steps, delta);
        measured.push(("learning_rate", networks.actor.adam.step().rate));
        Ok(measured)
    }

    fn policy(&self, networks: &Networks) -> Result<(Choice, Tensors)> {
        let (actor, critics) = (&networks.actor.target, &networks.critic.target);
        let tensors = DiffusionPolicy::tensors(actor, Some(critics), None)?;
        Ok((Choice::best_of(*self.config.candidates), tensors)) // Eq. 25
    }

    fn add_to<'a>(&'a mut self, dict: StateDict<'a>) -> StateDict<'a> {
        self.averages.add_to(dict.with("eta", &mut self.eta))
    }
}
