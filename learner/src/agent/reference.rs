//! The update in candle's tensors, differentiated by candle's autograd: the version to read, and to hold the fast one
//! against. Runs on any of candle's devices; a step reads back from there once, at its end.

use super::{AgentConfig, AgentError, AgentState, Guidance, StepMetrics, StepNoise, TargetReduce, cosine_decay};
use candle_core::backprop::GradStore;
use candle_core::{D, Device, Result, Tensor, Var};
use quad_dataset::Batch;
use quad_policy::{
    Architecture, Parameters, Schedule,
    reference::{Tensors, load, noise, sample, values},
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
    /// Behaviour-cloning strength η, `[]`.
    pub eta: Tensor,
    /// ν̂², `[]`; none before the first update.
    pub nu_squared: Option<Tensor>,
    /// Updates done.
    pub step: u64,
}

impl ReferenceState {
    /// An agent's state, copied to a device.
    pub fn new(state: &AgentState, device: &Device) -> std::result::Result<Self, AgentError> {
        let tensors = |parameters: &Parameters| -> std::result::Result<Tensors, AgentError> {
            Ok(load(&parameters.to_safetensors()?, device)?)
        };
        let moments = |actor: &Vec<f32>, critics: &Vec<f32>| {
            let mut parameters = state.online.clone();
            parameters.actor.clone_from(actor);
            parameters.critics.clone_from(critics);
            tensors(&parameters)
        };
        let split = |all: Tensors| all.into_iter().partition(|(name, _)| name.starts_with("actor"));
        let (actor, critics) = split(tensors(&state.online)?);
        let (target_actor, target_critics) = split(tensors(&state.target)?);
        Ok(Self {
            actor,
            critics,
            target_actor,
            target_critics,
            first: moments(&state.actor_moments.first, &state.critic_moments.first)?,
            second: moments(&state.actor_moments.second, &state.critic_moments.second)?,
            eta: Tensor::new(state.eta, device)?,
            nu_squared: state.nu_squared.map(|x| Tensor::new(x, device)).transpose()?,
            step: state.step,
        })
    }
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

/// Mean over all numbers of (x - y)², `[]`.
fn mean_square_error(x: &Tensor, y: &Tensor) -> Result<Tensor> {
    (x - y)?.sqr()?.mean_all()
}

/// Tensors `[]` as numbers, in one copy: the device works on its own until somebody reads from it.
fn numbers<const N: usize>(x: [&Tensor; N]) -> Result<[f32; N]> {
    let x = Tensor::stack(&x, 0)?.to_vec1::<f32>()?;
    x.try_into().map_err(|_| candle_core::Error::Msg("a tensor is not one number".into()))
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
        let bc_loss = mean_square_error(&inputs.epsilon, &predicted)?;
        let mut actor_loss = (&bc_loss * &state.eta)?;
        let zero = bc_loss.zeros_like()?;
        let mut lambda_mean = zero.clone();
        if self.config.guidance != Guidance::None {
            let (gradient, lambda) = self.guidance(state, &inputs, &noisy, &predicted.detach())?;
            lambda_mean = lambda.mean_all()?;
            let weight = lambda.unsqueeze(1)?.mul(&inputs.deviation)?;
            actor_loss = (actor_loss + (&predicted * gradient.broadcast_mul(&weight)?)?.mean_all()?)?;
        }
        let gradients = actor_loss.backward()?;
        let learning_rate = self.config.actor_learning_rate * decay;
        let actor_gradient_norm = self.adam(state, &actor_variables, &gradients, learning_rate)?;

        // Line 12: dual ascent on η.
        if let Some(threshold) = self.config.eta.threshold {
            let predicted = self::noise(&state.actor, &inputs.observations, &noisy, &inputs.t)?;
            let error = (mean_square_error(&inputs.epsilon, &predicted)? - f64::from(threshold))?;
            let eta = &self.config.eta;
            let raised = (&state.eta + (error.clamp(-1f32, 1f32)? * f64::from(eta.rate))?)?;
            state.eta = raised.clamp(eta.minimum, eta.maximum)?;
        }
        state.step += 1;
        if state.step.is_multiple_of(self.config.actor_ema_every) && state.step > self.config.actor_ema_start {
            ema(&mut state.target_actor, &state.actor, self.config.ema_rate)?;
        }
        let nu_squared = state.nu_squared.as_ref().unwrap_or(&zero);
        let q_mean = targets.mean_all()?;
        let [
            critic_loss,
            bc_loss,
            actor_loss,
            eta,
            lambda_mean,
            q_mean,
            nu_squared,
            critic_gradient_norm,
            actor_gradient_norm,
        ] = numbers([
            &critic_loss,
            &bc_loss,
            &actor_loss,
            &state.eta,
            &lambda_mean,
            &q_mean,
            nu_squared,
            &critic_gradient_norm,
            &actor_gradient_norm,
        ])?;
        Ok(StepMetrics {
            critic_loss,
            bc_loss,
            actor_loss,
            eta,
            lambda_mean,
            q_mean,
            nu_squared,
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
        let q_scale = (data.mean(0)?.abs()?.mean_all()? + 1e-6)?;

        // Actions for each critic, so that one pass gives the gradients of all: none has a part in another's.
        let actions = Var::from_tensor(&noisy.broadcast_left(self.architecture.critics)?)?;
        let q = values(&state.target_critics, &inputs.observations, &actions)?;
        let gradients = gradient_of(&q.sum_all()?.backward()?, "actions", &actions)?.broadcast_div(&q_scale)?;

        let norm = (predicted.sqr()?.sum_keepdim(1)?.sqrt()? + 1e-8)?;
        let direction = predicted.broadcast_div(&norm)?.unsqueeze(0)?;
        let alignment = gradients.broadcast_mul(&direction)?.sum(2)?;
        let (mean, variance) = mean_and_variance(&alignment)?;
        let batch_variance = mean.broadcast_sub(&mean.mean_all()?)?.sqr()?.mean_all()?;
        let rate = f64::from(self.config.nu_ema_rate);
        let nu_squared = match &state.nu_squared {
            Some(before) => ((before * (1.0 - rate))? + (batch_variance * rate)?)?,
            None => batch_variance,
        };
        let lambda = match self.config.guidance {
            Guidance::Quad => {
                let denominator = ((variance / f64::from(self.config.tau))? + f64::from(self.config.delta))?;
                denominator.broadcast_add(&nu_squared)?.recip()?.broadcast_mul(&nu_squared)?
            }
            Guidance::Dac | Guidance::None => variance.ones_like()?,
        };
        state.nu_squared = Some(nu_squared);
        Ok((gradients.mean(0)?, lambda))
    }

    /// Adam (0.9, 0.999, 1e-8) on the gradient clipped by its global norm, which is returned.
    fn adam(
        &self,
        state: &mut ReferenceState,
        variables: &[(String, Var)],
        all: &GradStore,
        rate: f32,
    ) -> Result<Tensor> {
        let squares = variables.iter().map(|(name, variable)| gradient_of(all, name, variable)?.sqr()?.sum_all());
        let norm = Tensor::stack(&squares.collect::<Result<Vec<_>>>()?, 0)?.sum_all()?.sqrt()?;
        let scale = (norm.recip()? * f64::from(self.config.gradient_clip))?.minimum(1f32)?;
        let count = (state.step + 1) as f64;
        for (name, variable) in variables {
            let gradient = gradient_of(all, name, variable)?.broadcast_mul(&scale)?;
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
