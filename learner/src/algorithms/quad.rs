//! QUAD (Algorithm 1 of the paper): a diffusion policy is cloned from the data and pulled along the critics' gradients,
//! as far as the critics agree on them. Equations are the paper's; where it is silent, docs/deviations.md says what holds.

mod config;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod golden;
mod metrics;

use super::algorithm::{
    AgentError, Algorithm, AlgorithmError, Definition, Hyperparameters, Minibatch, Setting, numbers,
};
use super::optimiser::{Adam, AdamStep, cosine_decay, follow};
use super::random::{Purpose, stream};
use candle_core::{DType, Device, Result, Tensor};
use candle_nn::loss::mse;
use config::{Eta, Guidance, Quad as Config, TargetReduce};
use metrics::METRICS;
use quad_policy::{
    Description, DiffusionPolicy, DiffusionShape, Ensemble, NoisePredictor, PolicyError, Tensors, Weights,
    mean_and_variance,
};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

/// What the learner has to know of it.
pub const DEFINITION: Definition = Definition {
    name: "quad",
    metrics: METRICS,
    settings: include_str!("../../../presets/quad.toml"),
    variant: Some("guidance"),
    read,
};

fn read(table: &toml::Table) -> std::result::Result<Box<dyn Hyperparameters>, AgentError> {
    Ok(Box::new(config::read(table)?))
}

impl Hyperparameters for Config {
    fn variant(&self) -> String {
        match self.guidance {
            Guidance::Quad => "quad",
            Guidance::Dac => "dac",
            Guidance::None => "none",
        }
        .to_owned()
    }

    fn summary(&self) -> String {
        let Self { samples, critics, hidden, .. } = self;
        format!("guidance {}, {samples} samples, {critics} critics, {hidden} wide", self.variant())
    }

    fn samples_candidates(&self) -> bool {
        true
    }

    fn start(&self, setting: &Setting) -> std::result::Result<Box<dyn Algorithm>, AlgorithmError> {
        Ok(Box::new(Quad::new(self.clone(), setting.clone())?))
    }
}

/// QUAD in the middle of a run.
pub(super) struct Quad {
    config: Config,
    setting: Setting,
    shape: DiffusionShape,
    /// ε_θ and its EMA.
    actor: NoisePredictor,
    target_actor: NoisePredictor,
    /// Q_1..Q_K and their EMA Q̂.
    critics: Ensemble,
    target_critics: Ensemble,
    actor_adam: Adam,
    critic_adam: Adam,
    /// Strength η of behaviour cloning, `[]`.
    eta: Tensor,
    /// ν̂² (Eq. 23), `[]`; none before the first guided update.
    nu_squared: Option<Tensor>,
}

/// The random numbers of one update.
struct Noise {
    /// Of the sampled next actions, `[T, B·S, a]`: a^T, then the reverse steps' noise from t = T down to 2.
    next: Tensor,
    /// Denoising step of each transition, in 1..=T, `[B]`.
    t: Vec<u32>,
    /// ε of Eq. 5, `[B, a]`.
    epsilon: Tensor,
}

/// What the critics say about noisy actions, and how far they are trusted.
struct Advice {
    /// ḡ: the mean over critics of ∇_a Q̂_k(s, a^t), over the mean of |Q̂_k(s, a)| (Eq. 10), `[B, a]`.
    gradient: Tensor,
    /// ν̂² after this batch (Eq. 23), `[]`.
    nu_squared: Tensor,
    /// λ (Eq. 24), `[B]`.
    lambda: Tensor,
    /// Share of the batch in which δ decides λ, `[]`.
    delta_share: Tensor,
}

impl Quad {
    fn new(config: Config, setting: Setting) -> std::result::Result<Self, AlgorithmError> {
        let shape = DiffusionShape {
            observation_dim: setting.observation_dim,
            action_dim: setting.action_dim,
            hidden: config.hidden,
            critics: config.critics,
            diffusion_steps: config.diffusion_steps,
        };
        let weights = |layout: quad_policy::Layout, network| {
            let mut generator = stream(setting.seed, Purpose::Weights, network);
            let values = Weights::initial(&layout, &mut generator, &setting.device)?;
            Weights::trainable(layout, &values)
        };
        let (actor, critics) = (weights(shape.actor().layout(), 0)?, weights(shape.critics().layout(), 1)?);
        let precision = setting.precision;
        Ok(Self {
            actor_adam: Adam::new(&actor)?,
            critic_adam: Adam::new(&critics)?,
            target_actor: NoisePredictor::new(shape.actor(), actor.copy()?, precision),
            target_critics: Ensemble::new(shape.critics(), critics.copy()?, precision),
            actor: NoisePredictor::new(shape.actor(), actor, precision),
            critics: Ensemble::new(shape.critics(), critics, precision),
            eta: Tensor::new(config.eta.initial, &setting.device)?,
            nu_squared: None,
            shape,
            config,
            setting,
        })
    }

    fn noise(&self, step: u64) -> Result<Noise> {
        let mut generator = stream(self.setting.seed, Purpose::Noise, step);
        let (b, a, device) = (self.setting.batch_size, self.shape.action_dim, &self.setting.device);
        let (steps, rows) = (self.config.diffusion_steps, b * self.config.samples);
        let mut normal = |n: usize| -> Vec<f32> { (0..n).map(|_| StandardNormal.sample(&mut generator)).collect() };
        let (next, epsilon) = (normal(steps * rows * a), normal(b * a));
        Ok(Noise {
            next: Tensor::from_vec(next, (steps, rows, a), device)?,
            epsilon: Tensor::from_vec(epsilon, (b, a), device)?,
            t: (0..b).map(|_| generator.random_range(1..=steps as u32)).collect(),
        })
    }

    /// One pass through Algorithm 1's loop; `step` counts from 0.
    fn step(&mut self, step: u64, batch: &Minibatch, noise: &Noise) -> Result<Vec<f32>> {
        let decay = cosine_decay(step, self.setting.total_steps);
        let (clip, count, ema_rate) = (Some(self.config.gradient_clip), step + 1, self.config.ema_rate);

        // Lines 4–7: every critic towards the lower confidence bound (Eq. 20).
        let targets = self.targets(batch, noise)?;
        let critic_loss = self.critics.squared_error(&batch.observations, &batch.actions, &targets)?;
        let adam = AdamStep { rate: self.config.critic_learning_rate * decay, clip, count };
        let critic_gradient_norm = self.critic_adam.step(self.critics.weights_mut(), &critic_loss.backward()?, adam)?;
        follow(self.target_critics.weights_mut(), self.critics.weights(), ema_rate)?;

        // Lines 8–11: behaviour cloning, pulled along the gradients that the critics agree on (Eq. 5 and 19).
        let (signal, deviation) =
            self.actor.schedule().noising(&noise.t, self.shape.action_dim, &self.setting.device)?;
        let noisy = ((&batch.actions * signal)? + (&noise.epsilon * &deviation)?)?;
        let t = Tensor::from_slice(&noise.t, noise.t.len(), &self.setting.device)?;
        let predicted = self.actor.predict(&batch.observations, &noisy, &t)?;
        let bc_loss = mse(&predicted, &noise.epsilon)?;
        let mut actor_loss = (&bc_loss * &self.eta)?;
        let zero = self.eta.zeros_like()?;
        let (mut lambda_mean, mut delta_share) = (zero.clone(), zero.clone());
        if self.config.guidance != Guidance::None {
            let advice = self.advice(batch, &noisy, &predicted.detach())?;
            let pull = (advice.gradient * deviation)?.broadcast_mul(&advice.lambda.unsqueeze(1)?)?;
            actor_loss = (actor_loss + (&predicted * pull)?.mean_all()?)?;
            (lambda_mean, delta_share) = (advice.lambda.mean_all()?, advice.delta_share);
            self.nu_squared = Some(advice.nu_squared);
        }
        let rate = self.config.actor_learning_rate * decay;
        let adam = AdamStep { rate, clip, count };
        let actor_gradient_norm = self.actor_adam.step(self.actor.weights_mut(), &actor_loss.backward()?, adam)?;

        // Line 12: dual ascent on η, with the actor as it is now.
        if let Some(threshold) = self.config.eta.threshold
            && self.config.guidance != Guidance::None
        {
            let predicted = self.actor.frozen().predict(&batch.observations, &noisy, &t)?;
            self.eta = self.ascended_eta((mse(&predicted, &noise.epsilon)? - f64::from(threshold))?)?;
        }
        if step.is_multiple_of(self.config.actor_ema_every) && step > self.config.actor_ema_start {
            follow(self.target_actor.weights_mut(), self.actor.weights(), ema_rate)?;
        }

        let nu_squared = self.nu_squared.as_ref().unwrap_or(&zero);
        let mut metrics = numbers(&[
            &targets.mean_all()?,
            &critic_loss,
            &bc_loss,
            &actor_loss,
            &self.eta,
            &lambda_mean,
            &delta_share,
            nu_squared,
            &critic_gradient_norm,
            &actor_gradient_norm,
        ])?;
        metrics.push(rate);
        Ok(metrics)
    }

    /// η after a step of dual ascent: `excess` is how far the BC loss is above its threshold, `[]`.
    fn ascended_eta(&self, excess: Tensor) -> Result<Tensor> {
        let Eta { rate, minimum, maximum, .. } = self.config.eta;
        let raised = (&self.eta + (excess.clamp(-1f32, 1f32)? * f64::from(rate))?)?;
        raised.clamp(minimum, maximum)
    }

    /// y = r + γ·mask·(mean - ρ·std over the critics of each one's value of s') (Eq. 20), `[B]`. Each critic's value of s'
    /// is the mean, or the largest, of its values of the sampled actions.
    fn targets(&self, batch: &Minibatch, noise: &Noise) -> Result<Tensor> {
        let next_actions = self.target_actor.sample(&batch.next_observations, &noise.next)?;
        let q = self.target_critics.values(&batch.next_observations, &next_actions)?;
        let q = q.reshape((self.config.critics, (), self.config.samples))?;
        let value = match self.config.target_reduce {
            TargetReduce::Mean => q.mean(2)?,
            // A maximum would drop a NaN; zero times their sum lets none get lost.
            TargetReduce::Max => (q.max(2)? + (q.sum(2)? * 0.0)?)?,
        };
        let (mean, variance) = mean_and_variance(&value)?;
        let bound = (mean - (variance.sqrt()? * f64::from(self.config.rho))?)?;
        &batch.rewards + ((bound * &batch.masks)? * f64::from(self.config.gamma))?
    }

    /// The target critics' gradients at noisy actions, and λ for each (Eq. 10 and 21–24); all of it constants.
    fn advice(&self, batch: &Minibatch, noisy: &Tensor, predicted: &Tensor) -> Result<Advice> {
        let (tau, delta) = (f64::from(self.config.tau), f64::from(self.config.delta));
        let scale = (self.target_critics.values(&batch.observations, &batch.actions)?.abs()?.mean_all()? + 1e-6)?;
        let gradients = self.target_critics.action_gradients(&batch.observations, noisy)?.broadcast_div(&scale)?;

        let size = (predicted.sqr()?.sum_keepdim(1)?.sqrt()? + 1e-8)?;
        let direction = predicted.broadcast_div(&size)?; // u, Eq. 21
        let alignment = gradients.broadcast_mul(&direction)?.sum(2)?; // l_k = u·g_k, [K, B]
        let (mean, variance) = mean_and_variance(&alignment)?; // l̄, and σ² of Eq. 22
        let spread = mean.broadcast_sub(&mean.mean_all()?)?.sqr()?.mean_all()?;
        let nu_squared = match &self.nu_squared {
            Some(before) => (before + ((spread - before)? * f64::from(self.config.nu_ema_rate))?)?,
            None => spread,
        };
        let (lambda, delta_share) = match self.config.guidance {
            Guidance::Quad => {
                let denominator = variance.affine(1.0 / tau, delta)?.broadcast_add(&nu_squared)?;
                let decided = denominator.lt(100.0 * delta)?.to_dtype(DType::F32)?.mean_all()?;
                (denominator.recip()?.broadcast_mul(&nu_squared)?, decided)
            }
            Guidance::Dac | Guidance::None => (variance.ones_like()?, nu_squared.zeros_like()?),
        };
        Ok(Advice { gradient: mean_and_variance(&gradients)?.0, nu_squared, lambda, delta_share })
    }
}

impl Algorithm for Quad {
    fn update(&mut self, step: u64, batch: &Minibatch) -> Result<Vec<f32>> {
        let noise = self.noise(step)?;
        self.step(step, batch, &noise)
    }

    fn policy(&self) -> Result<(Description, Tensors)> {
        let tensors = DiffusionPolicy::tensors(&self.target_actor, &self.target_critics)?;
        Ok((Description::Diffusion(self.shape), tensors))
    }

    fn state(&self) -> Result<Tensors> {
        let (actor, critics) = (self.actor.weights(), self.critics.weights());
        let mut tensors = actor.tensors("actor.")?;
        tensors.extend(critics.tensors("critic.")?);
        tensors.extend(self.target_actor.weights().tensors("target_actor.")?);
        tensors.extend(self.target_critics.weights().tensors("target_critic.")?);
        tensors.extend(self.actor_adam.tensors(actor, "actor.")?);
        tensors.extend(self.critic_adam.tensors(critics, "critic.")?);
        tensors.insert("eta".to_owned(), self.eta.reshape(1)?);
        if let Some(nu_squared) = &self.nu_squared {
            tensors.insert("nu_squared".to_owned(), nu_squared.reshape(1)?);
        }
        Ok(tensors)
    }

    fn load(&mut self, tensors: &mut Tensors) -> std::result::Result<(), PolicyError> {
        self.actor.weights_mut().load(tensors, "actor.")?;
        self.critics.weights_mut().load(tensors, "critic.")?;
        self.target_actor.weights_mut().load(tensors, "target_actor.")?;
        self.target_critics.weights_mut().load(tensors, "target_critic.")?;
        self.actor_adam.load(self.actor.weights(), tensors, "actor.")?;
        self.critic_adam.load(self.critics.weights(), tensors, "critic.")?;
        self.eta =
            scalar(tensors, "eta", &self.setting.device)?.ok_or_else(|| PolicyError::Missing("eta".to_owned()))?;
        self.nu_squared = scalar(tensors, "nu_squared", &self.setting.device)?;
        Ok(())
    }
}

/// Takes a tensor of one number out of `tensors`, if it is there.
fn scalar(tensors: &mut Tensors, name: &str, device: &Device) -> Result<Option<Tensor>> {
    tensors.remove(name).map(|tensor| tensor.reshape(())?.to_device(device)).transpose()
}
