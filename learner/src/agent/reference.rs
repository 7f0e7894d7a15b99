//! The update in candle's tensors, differentiated by candle's autograd: the version to read, and to hold the fast one
//! against. Runs on any of candle's devices.

use super::{AgentConfig, Guidance, StepMetrics, StepNoise, TargetReduce, cosine_decay};
use candle_core::backprop::GradStore;
use candle_core::{D, Device, Result, Tensor, Var};
use quad_dataset::Batch;
use quad_policy::{
    Architecture, Schedule,
    reference::{Tensors, noise, sample, values},
};

/// Everything that an update changes; the names are those of [`quad_policy::Parameters`].
#[derive(Clone, Debug)]
pub struct ReferenceState {
    /// ε_θ.
    pub actor: Tensors,
    /// Q_φ.
    pub critics: Tensors,
    /// EMA of ε_θ.
    pub target_actor: Tensors,
    /// EMA of Q_φ.
    pub target_critics: Tensors,
    /// Adam's first moments of all parameters.
    pub first: Tensors,
    /// Adam's second moments.
    pub second: Tensors,
    /// Behaviour-cloning strength η.
    pub eta: f32,
    /// ν̂², none before the first update.
    pub nu_squared: Option<f32>,
    /// Updates done.
    pub step: u64,
}

/// Trainable copies of weights: gradients are taken of these.
fn variables(weights: &Tensors) -> Result<(Vec<(String, Var)>, Tensors)> {
    let mut variables = Vec::new();
    let mut tensors = Tensors::new();
    for (name, tensor) in weights {
        let variable = Var::from_tensor(tensor)?;
        tensors.insert(name.clone(), variable.as_tensor().clone());
        variables.push((name.clone(), variable));
    }
    Ok((variables, tensors))
}

/// `[K, B]` → mean over K, and population variance over K.
fn mean_and_variance(x: &Tensor) -> Result<(Tensor, Tensor)> {
    let mean = x.mean_keepdim(0)?;
    let variance = x.broadcast_sub(&mean)?.sqr()?.mean(0)?;
    Ok((mean.squeeze(0)?, variance))
}

fn number(x: &Tensor) -> Result<f32> {
    x.to_scalar::<f32>()
}

/// One update.
pub struct Reference<'a> {
    /// The hyper-parameters.
    pub config: &'a AgentConfig,
    /// The networks' shapes.
    pub architecture: Architecture,
    /// Steps of the whole training.
    pub total_steps: u64,
    /// Where the tensors lie.
    pub device: Device,
}

/// A batch and its noise as tensors.
struct Inputs {
    observations: Tensor,
    actions: Tensor,
    rewards: Tensor,
    next_observations: Tensor,
    masks: Tensor,
    draws: Tensor,
    t: Tensor,
    epsilon: Tensor,
    /// sqrt(ᾱ_t) and sqrt(1 - ᾱ_t), `[B, 1]`.
    signal: Tensor,
    deviation: Tensor,
}

impl Reference<'_> {
    fn inputs(&self, schedule: &Schedule, batch: &Batch, noise: &StepNoise) -> Result<Inputs> {
        let Architecture { observation_dim: o, action_dim: a, .. } = self.architecture;
        let (b, rows) = (batch.rewards.len(), batch.rewards.len() * self.config.samples);
        let tensor = |x: &[f32], shape: &[usize]| Tensor::from_slice(x, shape, &self.device);
        let (signal, deviation): (Vec<f32>, Vec<f32>) = noise.t.iter().map(|t| schedule.noising(*t)).unzip();
        let t: Vec<f32> = noise.t.iter().map(|t| *t as f32).collect();
        Ok(Inputs {
            observations: tensor(&batch.observations, &[b, o])?,
            actions: tensor(&batch.actions, &[b, a])?,
            rewards: tensor(&batch.rewards, &[b])?,
            next_observations: tensor(&batch.next_observations, &[b, o])?,
            masks: tensor(&batch.masks, &[b])?,
            draws: tensor(&noise.next, &[schedule.steps(), rows, a])?,
            t: tensor(&t, &[b])?,
            epsilon: tensor(&noise.epsilon, &[b, a])?,
            signal: tensor(&signal, &[b, 1])?,
            deviation: tensor(&deviation, &[b, 1])?,
        })
    }

    /// One pass through Algorithm 1's loop.
    pub fn step(&self, state: &mut ReferenceState, batch: &Batch, noise: &StepNoise) -> Result<StepMetrics> {
        let schedule = Schedule::variance_preserving(self.architecture.diffusion_steps);
        let inputs = self.inputs(&schedule, batch, noise)?;
        let decay = cosine_decay(state.step, self.total_steps);

        // Lines 4–7: the critics.
        let targets = self.targets(&schedule, state, &inputs)?;
        let (critic_variables, critics) = variables(&state.critics)?;
        let q = values(&critics, &inputs.observations, &inputs.actions)?;
        let critic_loss = q.broadcast_sub(&targets.unsqueeze(0)?)?.sqr()?.mean_all()?;
        let gradients = critic_loss.backward()?;
        let rate = self.config.critic_learning_rate * decay;
        let critic_gradient_norm = self.adam(state, &critic_variables, &gradients, rate)?;
        ema(&mut state.target_critics, &state.critics, self.config.ema_rate)?;

        // Lines 8–11: the actor.
        let noisy =
            (inputs.actions.broadcast_mul(&inputs.signal)? + inputs.epsilon.broadcast_mul(&inputs.deviation)?)?;
        let (actor_variables, actor) = variables(&state.actor)?;
        let predicted = self::noise(&actor, &inputs.observations, &noisy, &inputs.t)?;
        let bc_loss = (&inputs.epsilon - &predicted)?.sqr()?.mean_all()?;
        let mut actor_loss = (&bc_loss * f64::from(state.eta))?;
        let mut lambda_mean = 0.0;
        if self.config.guidance != Guidance::None {
            let (gradient, lambda) = self.guidance(state, &inputs, &noisy, &predicted.detach())?;
            lambda_mean = number(&lambda.mean_all()?)?;
            let weight = lambda.unsqueeze(1)?.mul(&inputs.deviation)?;
            actor_loss = (actor_loss + (&predicted * gradient.broadcast_mul(&weight)?)?.mean_all()?)?;
        }
        let gradients = actor_loss.backward()?;
        let learning_rate = self.config.actor_learning_rate * decay;
        let actor_gradient_norm = self.adam(state, &actor_variables, &gradients, learning_rate)?;

        // Line 12: dual ascent on η.
        if let Some(threshold) = self.config.eta.threshold {
            let predicted = self::noise(&state.actor, &inputs.observations, &noisy, &inputs.t)?;
            let error = number(&(&inputs.epsilon - &predicted)?.sqr()?.mean_all()?)? - threshold;
            let eta = &self.config.eta;
            state.eta = (state.eta + eta.rate * error.clamp(-1.0, 1.0)).clamp(eta.minimum, eta.maximum);
        }
        state.step += 1;
        if state.step.is_multiple_of(self.config.actor_ema_every) && state.step > self.config.actor_ema_start {
            ema(&mut state.target_actor, &state.actor, self.config.ema_rate)?;
        }
        Ok(StepMetrics {
            critic_loss: number(&critic_loss)?,
            bc_loss: number(&bc_loss)?,
            actor_loss: number(&actor_loss)?,
            eta: state.eta,
            lambda_mean,
            q_mean: number(&targets.mean_all()?)?,
            nu_squared: state.nu_squared.unwrap_or(0.0),
            critic_gradient_norm,
            actor_gradient_norm,
            learning_rate,
        })
    }

    /// y = r + γ·mask·Q_LCB(s', a'), Eq. 20; `[B]`.
    fn targets(&self, schedule: &Schedule, state: &ReferenceState, inputs: &Inputs) -> Result<Tensor> {
        let (b, s) = (inputs.rewards.dim(0)?, self.config.samples);
        let o = self.architecture.observation_dim;
        let states = inputs.next_observations.unsqueeze(1)?.broadcast_as((b, s, o))?.reshape((b * s, o))?;
        let actions = sample(schedule, &state.target_actor, &states, &inputs.draws)?;
        let (mean, variance) = mean_and_variance(&values(&state.target_critics, &states, &actions)?)?;
        let bounds = (mean - (variance.sqrt()? * f64::from(self.config.rho))?)?.reshape((b, s))?;
        let bound = match self.config.target_reduce {
            TargetReduce::Mean => bounds.mean(D::Minus1)?,
            TargetReduce::Max => bounds.max(D::Minus1)?,
        };
        &inputs.rewards + ((bound * &inputs.masks)? * f64::from(self.config.gamma))?
    }

    /// The normalised ensemble-mean gradient `[B, a]` (Eq. 10) and λ `[B]` (Eq. 21–24), both constants.
    fn guidance(
        &self,
        state: &mut ReferenceState,
        inputs: &Inputs,
        noisy: &Tensor,
        predicted: &Tensor,
    ) -> Result<(Tensor, Tensor)> {
        let data = values(&state.target_critics, &inputs.observations, &inputs.actions)?;
        let q_scale = f64::from(number(&data.mean(0)?.abs()?.mean_all()?)?) + 1e-6;

        let each: Vec<Tensor> = (0..self.architecture.critics)
            .map(|k| {
                let critic = state.target_critics.iter().map(|(name, x)| Ok((name.clone(), x.narrow(0, k, 1)?)));
                let actions = Var::from_tensor(noisy)?;
                let q = values(&critic.collect::<Result<_>>()?, &inputs.observations, actions.as_tensor())?;
                let gradients = q.sum_all()?.backward()?;
                gradient_of(&gradients, "actions", &actions)? / q_scale
            })
            .collect::<Result<_>>()?;
        let gradients = Tensor::stack(&each, 0)?;

        let norm = (predicted.sqr()?.sum_keepdim(1)?.sqrt()? + 1e-8)?;
        let direction = predicted.broadcast_div(&norm)?.unsqueeze(0)?;
        let alignment = gradients.broadcast_mul(&direction)?.sum(2)?;
        let (mean, variance) = mean_and_variance(&alignment)?;
        let batch_variance = number(&mean.broadcast_sub(&mean.mean_all()?)?.sqr()?.mean_all()?)?;
        let rate = self.config.nu_ema_rate;
        let nu_squared =
            state.nu_squared.map_or(batch_variance, |before| (1.0 - rate) * before + rate * batch_variance);
        state.nu_squared = Some(nu_squared);
        let lambda = match self.config.guidance {
            Guidance::Quad => {
                let denominator =
                    ((variance / f64::from(self.config.tau))? + f64::from(nu_squared + self.config.delta))?;
                (denominator.recip()? * f64::from(nu_squared))?
            }
            Guidance::Dac | Guidance::None => variance.ones_like()?,
        };
        Ok((gradients.mean(0)?, lambda))
    }

    /// Adam (0.9, 0.999, 1e-8) on the gradient clipped by its global norm, which is returned.
    fn adam(&self, state: &mut ReferenceState, variables: &[(String, Var)], all: &GradStore, rate: f32) -> Result<f32> {
        let mut squares = 0.0;
        for (name, variable) in variables {
            squares += number(&gradient_of(all, name, variable)?.sqr()?.sum_all()?)?;
        }
        let norm = squares.sqrt();
        let scale = f64::from((self.config.gradient_clip / norm).min(1.0));
        let count = (state.step + 1) as f64;
        for (name, variable) in variables {
            let gradient = (gradient_of(all, name, variable)? * scale)?;
            let first = ((moment(&mut state.first, name)? * 0.9)? + (&gradient * 0.1)?)?;
            let second = ((moment(&mut state.second, name)? * 0.999)? + (gradient.sqr()? * 0.001)?)?;
            let unbiased = (&first / (1.0 - 0.9_f64.powf(count)))?;
            let deviation = ((&second / (1.0 - 0.999_f64.powf(count)))?.sqrt()? + 1e-8)?;
            let updated = (variable.as_tensor() - ((unbiased / deviation)? * f64::from(rate))?)?.detach();
            let weights = if name.starts_with("actor") { &mut state.actor } else { &mut state.critics };
            weights.insert(name.clone(), updated);
            state.first.insert(name.clone(), first);
            state.second.insert(name.clone(), second);
        }
        Ok(norm)
    }
}

fn gradient_of(gradients: &GradStore, name: &str, variable: &Var) -> Result<Tensor> {
    let missing = || candle_core::Error::Msg(format!("no gradient reaches {name:?}"));
    gradients.get(variable.as_tensor()).cloned().ok_or_else(missing)
}

fn moment(moments: &mut Tensors, name: &str) -> Result<Tensor> {
    moments.remove(name).ok_or_else(|| candle_core::Error::Msg(format!("no moments for {name:?}")))
}

/// `target = (1 - rate)·target + rate·online`.
fn ema(target: &mut Tensors, online: &Tensors, rate: f32) -> Result<()> {
    for (name, target) in target {
        let Some(online) = online.get(name) else { candle_core::bail!("no online tensor {name:?}") };
        *target = ((&*target * (1.0 - f64::from(rate)))? + (online * f64::from(rate))?)?;
    }
    Ok(())
}
