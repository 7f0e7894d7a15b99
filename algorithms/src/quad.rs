//! QUAD (Algorithm 1 of the paper): a diffusion policy is cloned from the data and pulled along the
//! critics' gradients, as far as the critics agree on them. Equations are the paper's; where it is
//! silent, docs/deviations.md says what holds.

mod config;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/quad.rs"]
mod golden;
mod guidance;
mod lambda;
mod metrics;
mod summary;

use super::algorithm::{Loss, Measured, largest};
use super::context::{Context, Minibatch};
use super::definition::{Axis, Definition, Reporting, Variant};
use super::denoising::Denoising;
use super::diffusion::{Diffusion, DiffusionUpdate, Networks};
use super::parts::{Parts, write};
use super::replay::{Computed, Inputs};
use candle_core::{Device, Result, Tensor};
use candle_nn::loss::mse;
use config::{Eta, Guidance, Quad as Config, TargetReduce};
use guidance::Guide;
use metrics::METRICS;
use quad_nn::{AdamStep, Reverse, Tensors, Weighted, cosine_decay, mean_and_variance};
use quad_policy::{Choice, DiffusionPolicy, DiffusionShape};
use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "quad",
    settings: include_str!("../../presets/quad.toml"),
    metrics: METRICS,
    report: Reporting {
        // DAC and behavior cloning (none) have names of their own.
        variant: Some(Variant { key: "guidance", called: str::to_owned }),
        counts: &["candidates"],
        axis: Some(Axis { key: "tau", symbol: "τ" }),
        summary: Some(summary::of),
    },
    check: |table| Config::read(table).map(drop),
    start: |table, context| Ok(Box::new(Config::read(table)?.start(context)?)),
};

/// QUAD beside its diffusion policy and critics.
struct Quad {
    config: Config,
    /// Strength η of behavior cloning, `[]`.
    eta: Tensor,
    /// ν̂² (Eq. 23), `[]`; none before the first guided update.
    nu_squared: Option<Tensor>,
    /// With guidance `mean`: the moving average of λ at each t, `[T]`; below 0 where there was none
    /// yet.
    lambda_means: Option<Tensor>,
}

/// The random numbers of one update.
#[derive(Clone)]
struct Noise {
    /// Noise of the sampled next actions, `[T, B·S, a]`.
    next: Tensor,
    /// t and ε of Eq. 5.
    denoising: Denoising,
    /// With guidance `shuffled`: the sample whose λ each takes, one of its own t, `[B]`.
    permutation: Option<Tensor>,
}

/// The actor's loss, and what it is made of.
struct ActorLoss {
    loss: Loss,
    /// a^t and ε_θ − ε, `[B, a]`.
    noisy: Tensor,
    error: Tensor,
    /// None without guidance.
    guide: Option<Guide>,
}

impl Inputs for Noise {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        let mut tensors = self.denoising.tensors();
        tensors.push(&mut self.next);
        tensors.extend(&mut self.permutation);
        tensors
    }
}

impl Config {
    fn start(self, context: Context) -> Result<Diffusion<Quad>> {
        let shape = DiffusionShape {
            actor: self.actor.clone(),
            critic: self.critic.clone(),
            critics: *self.critics,
            diffusion_steps: *self.diffusion_steps,
            reverse: Reverse::ClipClean,
            ..DiffusionShape::default()
        };
        let unset = || Tensor::full(-1f32, shape.diffusion_steps, &context.device);
        let update = Quad {
            eta: Tensor::new(*self.eta.initial, &context.device)?,
            nu_squared: None,
            lambda_means: (self.guidance == Guidance::Mean).then(unset).transpose()?,
            config: self,
        };
        Ok(Diffusion::new(Networks::new(shape, 0.0, context)?, update))
    }
}

impl Quad {
    /// y = r + γ·mask·(mean - ρ·std over the critics of each one's value of s') (Eq. 20), `[B]`.
    /// Each critic's value of s' is the mean, or the largest, of its values of the sampled actions.
    fn targets(&self, networks: &Networks, batch: &Minibatch, noise: &Tensor) -> Result<Tensor> {
        let next_actions = networks.target_actor.sample(&batch.next_observations, noise)?;
        let q = networks.target_critics.values(&batch.next_observations, &next_actions)?;
        let q = q.reshape((networks.shape.critics, (), *self.config.samples))?;
        let value = match self.config.target_reduce {
            TargetReduce::Mean => q.mean(2)?,
            TargetReduce::Max => largest(&q, 2)?,
        };
        let (mean, variance) = mean_and_variance(&value)?;
        let bound = (mean - (variance.sqrt()? * f64::from(*self.config.rho))?)?;
        batch.target(*self.config.gamma, &bound)
    }

    /// Lines 4–7: every critic toward the lower confidence bound (Eq. 20).
    fn critic_loss(&self, networks: &Networks, batch: &Minibatch, noise: &Noise) -> Result<Loss> {
        let targets = self.targets(networks, batch, &noise.next)?;
        let loss = networks.critics.network.squared_error(
            &batch.observations,
            &batch.actions,
            &targets,
        )?;
        Ok(Loss::new("critic_loss", loss).with("q_mean", targets.mean_all()?))
    }

    /// Lines 8–11: behavior cloning, pulled along the gradients that the critics agree on (Eq. 5
    /// and 19).
    fn actor_loss(
        &self,
        networks: &Networks,
        batch: &Minibatch,
        noise: &Noise,
    ) -> Result<ActorLoss> {
        let Denoising { epsilon, deviation, .. } = &noise.denoising;
        let (noisy, predicted) = networks.denoise(batch, &noise.denoising)?;
        let error = (&predicted - epsilon)?;
        let bc_loss = error.sqr()?.mean_all()?;
        let mut loss = (&bc_loss * &self.eta)?;
        let guide = (self.config.guidance != Guidance::None)
            .then(|| self.guide(networks, batch, &noisy, &predicted.detach(), noise))
            .transpose()?;
        if let Some(guide) = &guide {
            let pull = (&guide.gradient * deviation)?.broadcast_mul(&guide.lambda.unsqueeze(1)?)?;
            loss = (loss + (&predicted * pull)?.mean_all()?)?;
        }
        Ok(ActorLoss {
            loss: Loss::new("actor_loss", loss).with("bc_loss", bc_loss),
            noisy,
            error,
            guide,
        })
    }

    /// η after a step of dual ascent: `excess` is how far the BC loss is above its threshold, `[]`.
    fn ascended_eta(&self, excess: Tensor) -> Result<Tensor> {
        let Eta { rate, minimum, maximum, .. } = self.config.eta;
        let raised = (&self.eta + (excess.clamp(-1f32, 1f32)? * f64::from(*rate))?)?;
        raised.clamp(*minimum, *maximum)
    }
}

impl DiffusionUpdate for Quad {
    type Noise = Noise;

    fn noise(&self, networks: &Networks, generator: &mut ChaCha8Rng) -> Result<Noise> {
        let next = networks.chain_noise(*self.config.samples, generator)?;
        let denoising = networks.denoising(generator)?;
        let permutation = match self.config.guidance {
            Guidance::Shuffled => {
                Some(Tensor::new(shuffled(&denoising.t.to_vec1()?, generator), &Device::Cpu)?)
            }
            _ => None,
        };
        Ok(Noise { next, denoising, permutation })
    }

    fn begin(&mut self, networks: &mut Networks, step: u64) -> Result<()> {
        let (decay, clip) =
            (cosine_decay(step, networks.context.total_steps), Some(*self.config.gradient_clip));
        let adam = |rate: f32| AdamStep { rate: rate * decay, clip, count: step + 1 };
        networks.critics.adam.set(adam(*self.config.critic_learning_rate))?;
        networks.actor.adam.set(adam(*self.config.actor_learning_rate))
    }

    /// One pass through Algorithm 1's loop, but for the target actor.
    fn work(
        &mut self,
        networks: &mut Networks,
        batch: &Minibatch,
        noise: &Noise,
    ) -> Result<Computed> {
        let critic_loss = self.critic_loss(networks, batch, noise)?;
        let Networks { critics, target_critics, .. } = networks;
        let critic_gradient_norm = critics.apply_as_set(&critic_loss.value)?;
        target_critics.soft_update(&critics.network, *self.config.ema_rate)?;

        let ActorLoss { loss: actor_loss, noisy, error, guide } =
            self.actor_loss(networks, batch, noise)?;
        if let Some(guide) = &guide {
            match &self.nu_squared {
                Some(nu_squared) => write(nu_squared, &guide.nu_squared)?,
                None => self.nu_squared = Some(guide.nu_squared.copy()?),
            }
            if let (Some(means), Some(after)) = (&self.lambda_means, &guide.lambda_means) {
                write(means, after)?;
            }
        }
        let actor = &mut networks.actor;
        let actor_gradient_norm = actor.apply_as_set(&actor_loss.value)?;

        // Line 12: dual ascent on η, with the actor as it is now.
        if let Some(threshold) = self.config.eta.threshold
            && self.config.guidance != Guidance::None
        {
            let Denoising { t, epsilon, .. } = &noise.denoising;
            let predicted = actor.network.detach().predict(&batch.observations, &noisy, t)?;
            write(
                &self.eta,
                &self.ascended_eta((mse(&predicted, epsilon)? - f64::from(*threshold))?)?,
            )?;
        }

        let actor_loss =
            actor_loss.with("eta", self.eta.clone()).with("nu_squared", self.nu_squared.clone());
        let actor_loss = actor_loss.with("actor_gradient_norm", actor_gradient_norm);
        let losses = [critic_loss.with("critic_gradient_norm", critic_gradient_norm), actor_loss];
        Computed::new(&losses, &lambda::needed(guide.as_ref(), &error))
    }

    fn evaluate(&self, networks: &Networks, batch: &Minibatch, noise: &Noise) -> Result<Computed> {
        let ActorLoss { loss, error, guide, .. } = self.actor_loss(networks, batch, noise)?;
        let losses = [self.critic_loss(networks, batch, noise)?, loss];
        Computed::new(&losses, &lambda::needed(guide.as_ref(), &error))
    }

    /// Line 12, too: the actor's EMA.
    fn end(&mut self, networks: &mut Networks, step: u64) -> Result<()> {
        if step.is_multiple_of(*self.config.actor_ema_every) && step > self.config.actor_ema_start {
            networks.target_actor.soft_update(&networks.actor.network, *self.config.ema_rate)?;
        }
        Ok(())
    }

    fn measure(&self, networks: &Networks, noise: &Noise, of_guidance: &[f32]) -> Result<Measured> {
        let (t, steps) = (noise.denoising.t.to_vec1()?, networks.shape.diffusion_steps);
        let mut measured = lambda::measure(of_guidance, &t, steps, *self.config.delta);
        measured.push(("learning_rate", networks.actor.adam.step().rate));
        Ok(measured)
    }

    fn policy(&self, networks: &Networks) -> Result<(Choice, Tensors)> {
        let tensors =
            DiffusionPolicy::tensors(&networks.target_actor, &networks.target_critics, None)?;
        Ok((Choice::best_of(*self.config.candidates), tensors)) // Eq. 25
    }

    fn parts<'a>(&'a mut self, parts: Parts<'a>, device: &'a Device) -> Parts<'a> {
        let parts =
            parts.number("eta", &mut self.eta).maybe("nu_squared", &mut self.nu_squared, device);
        match &mut self.lambda_means {
            Some(means) => parts.number("lambda_means", means),
            None => parts,
        }
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
