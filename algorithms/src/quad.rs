//! QUAD (Algorithm 1 of the paper): a diffusion policy is cloned from the data and pulled along the critics' gradients,
//! as far as the critics agree on them. Equations are the paper's; where it is silent, docs/deviations.md says what holds.

mod config;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/quad.rs"]
mod golden;
mod guidance;
mod lambda;
mod metrics;

use super::algorithm::{Algorithm, AlgorithmError, Definition, largest, numbers};
use super::context::{Context, Minibatch};
use super::diffusion::{Denoising, chain_noise, noise_predictor};
use super::parts::Parts;
use super::random::{Purpose, stream};
use super::trained::{Trained, ensemble};
use candle_core::{Result, Tensor};
use candle_nn::loss::mse;
use config::{Eta, Guidance, Quad as Config, TargetReduce};
use metrics::METRICS;
use quad_policy::{
    AdamStep, Choice, DiffusionPolicy, DiffusionShape, Ensemble, Gradients, NoisePredictor, PolicyConfig, Reverse,
    Tensors, cosine_decay, mean_and_variance,
};
use rand::Rng;
use rand::seq::SliceRandom;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "quad",
    settings: include_str!("../../presets/quad.toml"),
    variant: Some("guidance"),
    metrics: METRICS,
    check: |table| Config::read(table).map(drop),
    start: |table, context| Ok(Box::new(Quad::new(Config::read(table)?, context)?)),
};

/// QUAD in the middle of a run.
pub(super) struct Quad {
    config: Config,
    context: Context,
    shape: DiffusionShape,
    /// ε_θ and its EMA.
    actor: Trained<NoisePredictor>,
    target_actor: NoisePredictor,
    /// Q_1..Q_K and their EMA Q̂.
    critics: Trained<Ensemble>,
    target_critics: Ensemble,
    /// Strength η of behaviour cloning, `[]`.
    eta: Tensor,
    /// ν̂² (Eq. 23), `[]`; none before the first guided update.
    nu_squared: Option<Tensor>,
    /// With guidance `mean`: the moving average of λ at each t, `[T]`; below 0 where there was none yet.
    lambda_means: Option<Tensor>,
}

/// The random numbers of one update.
struct Noise {
    /// Of the sampled next actions, `[T, B·S, a]`.
    next: Tensor,
    /// t and ε of Eq. 5.
    denoising: Denoising,
    /// With guidance `shuffled`: the sample whose λ each takes, one of its own t, `[B]`.
    permutation: Option<Tensor>,
}

impl Quad {
    fn new(config: Config, context: Context) -> std::result::Result<Self, AlgorithmError> {
        let shape = DiffusionShape {
            observation_dim: context.observation_dim(),
            action_dim: context.action_dim(),
            actor: config.actor.clone(),
            critic: config.critic.clone(),
            value: None,
            critics: *config.critics,
            diffusion_steps: *config.diffusion_steps,
            reverse: Reverse::ClipClean,
        };
        let (actor, target_actor) = noise_predictor(shape.actor(), 0.0, &context, 0)?;
        let critics = ensemble(shape.critics(), &context, 1)?;
        let unset = || Tensor::full(-1f32, shape.diffusion_steps, &context.device);
        Ok(Self {
            actor,
            target_actor,
            target_critics: critics.network.copy()?,
            critics,
            eta: Tensor::new(*config.eta.initial, &context.device)?,
            nu_squared: None,
            lambda_means: (config.guidance == Guidance::Mean).then(unset).transpose()?,
            shape,
            config,
            context,
        })
    }

    fn noise(&self, step: u64) -> Result<Noise> {
        let mut generator = stream(self.context.seed, Purpose::Noise, step);
        let (actor, b, device) = (self.actor.network.shape(), self.context.batch_size, &self.context.device);
        let next = chain_noise(actor, b * *self.config.samples, &mut generator, device)?;
        let denoising = Denoising::draw(actor, b, &mut generator, device)?;
        let permutation = (self.config.guidance == Guidance::Shuffled)
            .then(|| Tensor::from_vec(shuffled(&denoising.t, &mut generator), b, device))
            .transpose()?;
        Ok(Noise { next, denoising, permutation })
    }

    /// One pass through Algorithm 1's loop; `step` counts from 0.
    fn step(&mut self, step: u64, batch: &Minibatch, noise: &Noise) -> Result<Vec<f32>> {
        let decay = cosine_decay(step, self.context.total_steps);
        let (clip, count, ema_rate) = (Some(*self.config.gradient_clip), step + 1, *self.config.ema_rate);

        // Lines 4–7: every critic towards the lower confidence bound (Eq. 20).
        let targets = self.targets(batch, noise)?;
        let critic_loss = self.critics.network.squared_error(&batch.observations, &batch.actions, &targets)?;
        let adam = AdamStep { rate: *self.config.critic_learning_rate * decay, clip, count };
        let critic_gradient_norm = self.critics.descend(&Gradients::of(&critic_loss)?, adam)?;
        self.target_critics.weights_mut().ema_update(self.critics.network.weights(), ema_rate)?;

        // Lines 8–11: behaviour cloning, pulled along the gradients that the critics agree on (Eq. 5 and 19).
        let epsilon = &noise.denoising.epsilon;
        let noisy = noise.denoising.noisy(self.actor.network.schedule(), &batch.actions)?;
        let predicted = self.actor.network.predict(&batch.observations, &noisy.actions, &noisy.t)?;
        let error = (&predicted - epsilon)?;
        let bc_loss = error.sqr()?.mean_all()?;
        let mut actor_loss = (&bc_loss * &self.eta)?;
        let guide = (self.config.guidance != Guidance::None)
            .then(|| self.guide(batch, &noisy, &predicted.detach(), noise.permutation.as_ref()))
            .transpose()?;
        if let Some(guide) = &guide {
            let pull = (&guide.gradient * &noisy.deviation)?.broadcast_mul(&guide.lambda.unsqueeze(1)?)?;
            actor_loss = (actor_loss + (&predicted * pull)?.mean_all()?)?;
            self.nu_squared = Some(guide.nu_squared.clone());
            self.lambda_means.clone_from(&guide.lambda_means);
        }
        let rate = *self.config.actor_learning_rate * decay;
        let actor_gradient_norm = self.actor.descend(&Gradients::of(&actor_loss)?, AdamStep { rate, clip, count })?;

        // Line 12: dual ascent on η, with the actor as it is now.
        if let Some(threshold) = self.config.eta.threshold
            && self.config.guidance != Guidance::None
        {
            let predicted = self.actor.network.detach().predict(&batch.observations, &noisy.actions, &noisy.t)?;
            self.eta = self.ascended_eta((mse(&predicted, epsilon)? - f64::from(*threshold))?)?;
        }
        if step.is_multiple_of(*self.config.actor_ema_every) && step > self.config.actor_ema_start {
            self.target_actor.weights_mut().ema_update(self.actor.network.weights(), ema_rate)?;
        }

        let (mean, zero) = (targets.mean_all()?, self.eta.zeros_like()?);
        let mut measured = vec![&mean, &critic_loss, &bc_loss, &actor_loss, &self.eta];
        measured.extend([self.nu_squared.as_ref().unwrap_or(&zero), &critic_gradient_norm, &actor_gradient_norm]);
        let own = measured.len();
        measured.extend(guide.iter().flat_map(|guide| lambda::needed(guide, &error)));
        let mut metrics = numbers(&measured)?;
        let (of_guidance, t) = (metrics.split_off(own), &noise.denoising.t);
        metrics.push(rate);
        metrics.extend(lambda::measure(&of_guidance, t, self.shape.diffusion_steps, *self.config.delta));
        Ok(metrics)
    }

    /// η after a step of dual ascent: `excess` is how far the BC loss is above its threshold, `[]`.
    fn ascended_eta(&self, excess: Tensor) -> Result<Tensor> {
        let Eta { rate, minimum, maximum, .. } = self.config.eta;
        let raised = (&self.eta + (excess.clamp(-1f32, 1f32)? * f64::from(*rate))?)?;
        raised.clamp(*minimum, *maximum)
    }

    /// y = r + γ·mask·(mean - ρ·std over the critics of each one's value of s') (Eq. 20), `[B]`. Each critic's value of s'
    /// is the mean, or the largest, of its values of the sampled actions.
    fn targets(&self, batch: &Minibatch, noise: &Noise) -> Result<Tensor> {
        let next_actions = self.target_actor.sample(&batch.next_observations, &noise.next)?;
        let q = self.target_critics.values(&batch.next_observations, &next_actions)?;
        let q = q.reshape((self.shape.critics, (), *self.config.samples))?;
        let value = match self.config.target_reduce {
            TargetReduce::Mean => q.mean(2)?,
            TargetReduce::Max => largest(&q, 2)?,
        };
        let (mean, variance) = mean_and_variance(&value)?;
        let bound = (mean - (variance.sqrt()? * f64::from(*self.config.rho))?)?;
        batch.target(*self.config.gamma, &bound)
    }
}

/// A permutation that leaves each sample's t as it is.
fn shuffled(t: &[u32], generator: &mut impl Rng) -> Vec<u32> {
    let rows = || 0..t.len() as u32;
    let mut others = Vec::from_iter(rows());
    others.shuffle(generator);
    // Both in the order of t: the n-th sample of a t takes from the n-th of the shuffled ones.
    let mut takers = Vec::from_iter(rows());
    takers.sort_by_key(|row| t[*row as usize]);
    others.sort_by_key(|row| t[*row as usize]);
    let mut permutation = vec![0; t.len()];
    takers.into_iter().zip(others).for_each(|(taker, other)| permutation[taker as usize] = other);
    permutation
}

impl Algorithm for Quad {
    fn items(&self) -> usize {
        self.context.transitions.len()
    }

    fn update(&mut self, step: u64, items: &[u32]) -> Result<Vec<f32>> {
        let (batch, noise) = (self.context.batch(items)?, self.noise(step)?);
        self.step(step, &batch, &noise)
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let tensors = DiffusionPolicy::tensors(&self.target_actor, &self.target_critics, None)?;
        let choice = Choice::best_of(*self.config.candidates); // Eq. 25
        Ok((PolicyConfig::Diffusion { shape: self.shape.clone(), choice }, tensors))
    }

    fn parts(&mut self) -> Parts<'_> {
        let parts = Parts::default()
            .trained("actor", &mut self.actor)
            .trained("critic", &mut self.critics)
            .weights("target_actor", self.target_actor.weights_mut())
            .weights("target_critic", self.target_critics.weights_mut())
            .number("eta", &mut self.eta)
            .maybe("nu_squared", &mut self.nu_squared, &self.context.device);
        match &mut self.lambda_means {
            Some(means) => parts.number("lambda_means", means),
            None => parts,
        }
    }
}
