//! The QUAD update, Algorithm 1 of the paper.
//!
//! [`Agent::step`] reads like the algorithm; `target` (Eq. 20), `guidance` (Eq. 21–24) and `adam` are its parts.
//! [`reference`] is the same update in candle's tensors with autograd: plainer, slower on a CPU, and what a GPU runs, by
//! [`TensorAgent`]. Both are held against numbers from an independent implementation (docs/golden.md) and against each
//! other.

pub mod adam;
mod config;
mod guidance;
mod noise;
pub mod reference;
mod target;
mod tensor;
mod trainee;

pub use adam::Moments;
pub use config::{AgentConfig, ConfigError, EtaConfig, Guidance, TargetReduce};
pub use guidance::Uncertainty;
pub use noise::StepNoise;
pub use tensor::TensorAgent;
pub use trainee::Trainee;

use adam::{AdamStep, adam, cosine_decay, ema, reduce};
use noise::NoiseSource;
use quad_dataset::Batch;
use quad_policy::{Architecture, CriticEnsemble, NoisePredictor, NoisyActions, Parameters, PolicyError, StateActions};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use target::LowerConfidenceBound;

/// Everything that an update changes.
#[derive(Clone, Debug, PartialEq)]
pub struct AgentState {
    /// ε_θ and Q_φ.
    pub online: Parameters,
    /// Their EMA.
    pub target: Parameters,
    /// Adam's moments of the actor.
    pub actor_moments: Moments,
    /// Adam's moments of the critics.
    pub critic_moments: Moments,
    /// Behaviour-cloning strength η.
    pub eta: f32,
    /// ν̂² (Eq. 23); none before the first update.
    pub nu_squared: Option<f32>,
    /// Updates done.
    pub step: u64,
}

/// What an update reports.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepMetrics {
    /// Mean over critics and batch of (Q_k - y)², Eq. 20.
    pub critic_loss: f32,
    /// Mean over batch and dimensions of (ε - ε_θ)².
    pub bc_loss: f32,
    /// Eq. 19.
    pub actor_loss: f32,
    /// η after the update.
    pub eta: f32,
    /// Mean λ over the batch; 1 without uncertainty weighting, 0 without guidance.
    pub lambda_mean: f32,
    /// Mean target y over the batch.
    pub q_mean: f32,
    /// ν̂² after the update; 0 without guidance.
    pub nu_squared: f32,
    /// Global norm of the critics' gradient before clipping.
    pub critic_gradient_norm: f32,
    /// Global norm of the actor's gradient before clipping.
    pub actor_gradient_norm: f32,
    /// The actor's learning rate in this update.
    pub learning_rate: f32,
}

/// What an update works out on its way, kept for tests and benchmarks to look at; each as long as its doc says.
#[derive(Debug, Default)]
pub struct Intermediates {
    /// a', `B × S × a`.
    pub next_actions: Vec<f32>,
    /// y, B.
    pub targets: Vec<f32>,
    /// a^t, `B × a`.
    pub noisy_actions: Vec<f32>,
    /// ε_θ(a^t, s, t), `B × a`.
    pub predicted_noise: Vec<f32>,
    /// Mean |Q̂(s, a)| over the batch, + 1e-6.
    pub q_scale: f32,
    /// g_k, `K × B × a`: ∇_a Q̂_k(s, a^t), over `q_scale`.
    pub action_gradients: Vec<f32>,
    /// Eq. 21–23.
    pub uncertainty: Uncertainty,
    /// λ, B; empty without guidance.
    pub lambda: Vec<f32>,
    values: Vec<f32>,
    critic_gradient: Vec<f32>,
    actor_gradient: Vec<f32>,
}

/// Why an update cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// A hyper-parameter is out of range.
    #[error("the hyper-parameters are not usable")]
    Config(#[from] ConfigError),
    /// The batch has other dimensions than the networks.
    #[error("a batch's {array} has {found} numbers, the networks expect {expected}")]
    Batch {
        /// Which array.
        array: &'static str,
        /// Its length.
        found: usize,
        /// What the architecture asks for.
        expected: usize,
    },
    /// Weights cannot be written or read.
    #[error("the weights cannot be written")]
    Weights(#[from] PolicyError),
    /// A tensor cannot be computed or moved.
    #[error("candle failed")]
    Tensor(#[from] candle_core::Error),
}

/// Trains an actor and its critics.
pub struct Agent {
    config: AgentConfig,
    total_steps: u64,
    actor: NoisePredictor,
    critics: CriticEnsemble,
    state: AgentState,
    source: NoiseSource,
    noise: StepNoise,
    seen: Intermediates,
}

impl AgentState {
    /// Freshly initialised networks, their targets equal to them.
    pub fn new(architecture: &Architecture, config: &AgentConfig, seed: u64) -> Self {
        let online = Parameters::initialise(architecture, &mut ChaCha8Rng::seed_from_u64(seed));
        Self {
            actor_moments: Moments::zeros(online.actor.len()),
            critic_moments: Moments::zeros(online.critics.len()),
            target: online.clone(),
            online,
            eta: config.eta.initial,
            nu_squared: None,
            step: 0,
        }
    }
}

impl Agent {
    /// An agent at step 0; its learning rates reach 0 at `total_steps`.
    pub fn new(
        architecture: Architecture,
        config: &AgentConfig,
        total_steps: u64,
        seed: u64,
    ) -> Result<Self, AgentError> {
        config.validate()?;
        Ok(Self::from_state(AgentState::new(&architecture, config, seed), config, total_steps, seed))
    }

    /// An agent that goes on from a state.
    pub fn from_state(state: AgentState, config: &AgentConfig, total_steps: u64, seed: u64) -> Self {
        let architecture = state.online.architecture();
        Self {
            actor: NoisePredictor::new(architecture),
            critics: CriticEnsemble::new(architecture),
            source: NoiseSource::new(config, architecture.action_dim, seed),
            config: config.clone(),
            total_steps,
            state,
            noise: StepNoise::default(),
            seen: Intermediates::default(),
        }
    }

    /// The networks and all else that training changes.
    pub fn state(&self) -> &AgentState {
        &self.state
    }

    /// What the last update worked out on its way.
    pub fn intermediates(&self) -> &Intermediates {
        &self.seen
    }

    /// The target networks as a safetensors file, ready to be acted with.
    pub fn target_safetensors(&self) -> Result<Vec<u8>, AgentError> {
        Ok(self.state.target.to_safetensors()?)
    }

    /// One update with noise from the agent's own stream.
    pub fn update(&mut self, batch: &Batch) -> Result<StepMetrics, AgentError> {
        let mut noise = std::mem::take(&mut self.noise);
        self.source.fill(&mut noise);
        let metrics = self.step(batch, &noise);
        self.noise = noise;
        metrics
    }

    /// One pass through Algorithm 1's loop with the noise given.
    pub fn step(&mut self, batch: &Batch, noise: &StepNoise) -> Result<StepMetrics, AgentError> {
        check_batch(self.state.online.architecture(), &self.config, batch)?;
        // As a whole on a thread of the pool: else each of its parallel parts would wake one up and wait for it.
        Ok(rayon::scope(|_| self.step_checked(batch, noise)))
    }

    fn step_checked(&mut self, batch: &Batch, noise: &StepNoise) -> StepMetrics {
        let decay = cosine_decay(self.state.step, self.total_steps);
        let (critic_loss, critic_gradient_norm) = self.update_critics(batch, noise, decay);
        let actor = self.update_actor(batch, noise, decay);
        self.state.step += 1;
        if self.state.step.is_multiple_of(self.config.actor_ema_every) && self.state.step > self.config.actor_ema_start
        {
            ema(&mut self.state.target.actor, &self.state.online.actor, self.config.ema_rate);
        }
        let targets = &self.seen.targets;
        StepMetrics {
            critic_loss,
            critic_gradient_norm,
            q_mean: targets.iter().sum::<f32>() / targets.len() as f32,
            ..actor
        }
    }

    /// Algorithm 1, lines 4–7: regress every critic to the lower confidence bound at actions of the target actor.
    fn update_critics(&mut self, batch: &Batch, noise: &StepNoise, decay: f32) -> (f32, f32) {
        let (config, state, seen) = (&self.config, &mut self.state, &mut self.seen);
        let Architecture { action_dim, critics, .. } = *state.online.architecture();
        let rows = batch.rewards.len() * config.samples;

        seen.next_actions.resize(rows * action_dim, 0.0);
        let (states, samples) = (&batch.next_observations, config.samples);
        let actor = &state.target.actor;
        let rounded = self.actor.round(actor, config.precision);
        self.actor.sample(actor, &rounded, states, samples, &noise.next, &mut seen.next_actions);

        seen.values.resize(critics * rows, 0.0);
        let next = StateActions { observations: states, actions: &seen.next_actions, repeat: samples };
        let rounded = self.critics.round(&state.target.critics, config.precision);
        self.critics.values(&state.target.critics, &rounded, next, &mut seen.values);
        let bound =
            LowerConfidenceBound { gamma: config.gamma, rho: config.rho, samples, reduce: config.target_reduce };
        bound.targets(&seen.values, &batch.rewards, &batch.masks, &mut seen.targets);

        let len = self.critics.parameters();
        seen.critic_gradient.resize(self.critics.gradient_tiles(batch.rewards.len()) * len, 0.0);
        let scale = 1.0 / (critics * batch.rewards.len()) as f32;
        let (s, a, online) = (&batch.observations, &batch.actions, &mut state.online.critics);
        let loss = self.critics.regress(online, s, a, &seen.targets, scale, &mut seen.critic_gradient);
        let norm = reduce(&mut seen.critic_gradient, len);
        let step = AdamStep {
            learning_rate: config.critic_learning_rate * decay,
            clip: config.gradient_clip,
            count: state.step + 1,
        };
        adam(step, norm, online, &mut state.critic_moments, &seen.critic_gradient[..len]);
        ema(&mut state.target.critics, online, config.ema_rate);
        (loss, norm)
    }

    /// Algorithm 1, lines 8–12: behaviour cloning along trusted Q-gradients, then dual ascent on η.
    fn update_actor(&mut self, batch: &Batch, noise: &StepNoise, decay: f32) -> StepMetrics {
        self.add_noise(batch, noise);
        let noisy = NoisyActions { observations: &batch.observations, actions: &self.seen.noisy_actions, t: &noise.t };
        self.seen.predicted_noise.resize(noise.epsilon.len(), 0.0);
        let recording = self.actor.record(&self.state.online.actor, noisy, &mut self.seen.predicted_noise);
        let bc_loss = mean_square_error(&noise.epsilon, &self.seen.predicted_noise);
        if self.config.guidance != Guidance::None {
            self.weigh_gradients(batch);
        }

        let (config, state, seen) = (&self.config, &mut self.state, &mut self.seen);
        let noisy = NoisyActions { observations: &batch.observations, actions: &seen.noisy_actions, t: &noise.t };
        let (a, count) = (state.online.architecture().action_dim, noise.epsilon.len() as f32);
        // λ·w(t)·ḡ of a row, per dimension; nothing without guidance.
        let guidance = |i: usize, j: usize| match seen.lambda.get(i) {
            Some(lambda) => lambda * self.actor.schedule().noising(noise.t[i]).1 * seen.uncertainty.gradient[i * a + j],
            None => 0.0,
        };
        let guidance_loss = (0..seen.predicted_noise.len()).map(|n| guidance(n / a, n % a) * seen.predicted_noise[n]);
        let guidance_loss = guidance_loss.sum::<f32>() / count;
        seen.actor_gradient.resize(state.online.actor.len(), 0.0);
        let errors = seen.predicted_noise.iter().zip(&noise.epsilon).map(|(predicted, epsilon)| predicted - epsilon);
        let gradient = errors.enumerate().map(|(n, error)| (2.0 * state.eta * error + guidance(n / a, n % a)) / count);
        let gradient: Vec<f32> = gradient.collect();
        self.actor.differentiate(&state.online.actor, noisy, recording, &gradient, &mut seen.actor_gradient);
        let norm = reduce(&mut seen.actor_gradient, state.online.actor.len());
        let learning_rate = config.actor_learning_rate * decay;
        let step = AdamStep { learning_rate, clip: config.gradient_clip, count: state.step + 1 };
        let eta = state.eta;
        adam(step, norm, &mut state.online.actor, &mut state.actor_moments, &seen.actor_gradient);

        if let Some(threshold) = config.eta.threshold {
            self.actor.predict(&state.online.actor, noisy, &mut seen.predicted_noise);
            let error = mean_square_error(&noise.epsilon, &seen.predicted_noise) - threshold;
            let raised = eta + config.eta.rate * error.clamp(-1.0, 1.0);
            state.eta = raised.clamp(config.eta.minimum, config.eta.maximum);
        }
        StepMetrics {
            bc_loss,
            actor_loss: eta * bc_loss + guidance_loss,
            eta: state.eta,
            lambda_mean: seen.lambda.iter().fold(0.0, |sum, lambda| sum + lambda) / seen.lambda.len().max(1) as f32,
            nu_squared: state.nu_squared.unwrap_or(0.0),
            actor_gradient_norm: norm,
            learning_rate,
            ..StepMetrics::default()
        }
    }

    /// a^t = sqrt(ᾱ_t)·a + sqrt(1 - ᾱ_t)·ε, Eq. 5.
    fn add_noise(&mut self, batch: &Batch, noise: &StepNoise) {
        let a = self.state.online.architecture().action_dim;
        self.seen.noisy_actions.clear();
        for (n, (action, epsilon)) in batch.actions.iter().zip(&noise.epsilon).enumerate() {
            let (signal, deviation) = self.actor.schedule().noising(noise.t[n / a]);
            self.seen.noisy_actions.push(signal * action + deviation * epsilon);
        }
    }

    /// The target critics' gradients at a^t over their mean magnitude, and λ for each (Eq. 10, 21–24).
    fn weigh_gradients(&mut self, batch: &Batch) {
        let (config, state, seen) = (&self.config, &mut self.state, &mut self.seen);
        let Architecture { action_dim, critics, .. } = *state.online.architecture();
        let (observations, rows) = (&batch.observations, batch.rewards.len());
        seen.values.resize(critics * rows, 0.0);
        let data = StateActions { observations, actions: &batch.actions, repeat: 1 };
        let rounded = self.critics.round(&state.target.critics, config.precision);
        self.critics.values(&state.target.critics, &rounded, data, &mut seen.values);
        let mean_over_critics = |i: usize| seen.values.iter().skip(i).step_by(rows).sum::<f32>() / critics as f32;
        seen.q_scale = (0..rows).map(|i| mean_over_critics(i).abs()).sum::<f32>() / rows as f32 + 1e-6;

        seen.action_gradients.resize(critics * rows * action_dim, 0.0);
        let gradients = &mut seen.action_gradients;
        self.critics.action_gradients(&state.target.critics, observations, &seen.noisy_actions, gradients);
        gradients.iter_mut().for_each(|g| *g /= seen.q_scale);

        seen.uncertainty.measure(&seen.action_gradients, &seen.predicted_noise, action_dim);
        let batch_variance = seen.uncertainty.batch_variance;
        let nu_squared = match state.nu_squared {
            Some(before) => (1.0 - config.nu_ema_rate) * before + config.nu_ema_rate * batch_variance,
            None => batch_variance,
        };
        state.nu_squared = Some(nu_squared);
        let weight = |variance: &f32| match config.guidance {
            Guidance::Quad => guidance::weight(nu_squared, *variance, config.tau, config.delta),
            Guidance::Dac | Guidance::None => 1.0,
        };
        seen.lambda.clear();
        seen.lambda.extend(seen.uncertainty.variance.iter().map(weight));
    }
}

fn check_batch(architecture: &Architecture, config: &AgentConfig, batch: &Batch) -> Result<(), AgentError> {
    let Architecture { observation_dim, action_dim, .. } = *architecture;
    let size = config.batch_size;
    for (array, found, expected) in [
        ("observations", batch.observations.len(), size * observation_dim),
        ("actions", batch.actions.len(), size * action_dim),
        ("rewards", batch.rewards.len(), size),
        ("next observations", batch.next_observations.len(), size * observation_dim),
        ("masks", batch.masks.len(), size),
    ] {
        if found != expected {
            return Err(AgentError::Batch { array, found, expected });
        }
    }
    Ok(())
}

/// Mean over all numbers of (x - y)².
fn mean_square_error(x: &[f32], y: &[f32]) -> f32 {
    x.iter().zip(y).map(|(x, y)| (x - y) * (x - y)).sum::<f32>() / x.len() as f32
}
