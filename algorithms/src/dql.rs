//! Diffusion-QL (Wang, Hunt and Zhou 2022, "Diffusion Policies as an Expressive Policy Class for Offline Reinforcement
//! Learning"): a diffusion policy that is cloned from the data and moved towards actions of large Q, by the gradient through
//! its whole reverse chain. Equations are that paper's; where its authors' code does otherwise, docs/deviations.md says so.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/dql.rs"]
mod golden;

use super::algorithm::{Algorithm, AlgorithmError, Definition, Metric, largest, numbers, read, smaller};
use super::context::{Context, Minibatch};
use super::diffusion::{Denoising, chain_noise, noise_predictor};
use super::hyperparameters::{Candidates, Count, NotNegative, Positive, Rate, Share, Steps};
use super::parts::Parts;
use super::random::{Purpose, stream};
use super::trained::{Trained, ensemble};
use candle_core::{Result, Tensor};
use candle_nn::loss::mse;
use quad_policy::{
    AdamStep, Choice, DiffusionPolicy, DiffusionShape, Ensemble, Gradients, MlpConfig, NoisePredictor, PolicyConfig,
    Reduce, Reverse, Rule, Tensors,
};
use rand::Rng;
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "dql",
    settings: include_str!("../../presets/dql.toml"),
    variant: None,
    metrics: METRICS,
    check: |table| read::<Config>(table).map(drop),
    start: |table, context| Ok(Box::new(Dql::new(read(table)?, context)?)),
};

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;

const METRICS: &[Metric] = &[
    Metric {
        name: "q_mean",
        label: "",
        help: "Mean over the batch of the critics' target y = r + γ·mask·min_k Q̂_k(s', a'), with a' from the target actor (Diffusion-QL's Eq. 4).",
    },
    Metric {
        name: "critic_loss",
        label: "critic loss",
        help: "Sum over both critics of the mean over the batch of (Q_k(s, a) − y)² (Diffusion-QL's Eq. 4).",
    },
    Metric {
        name: "bc_loss",
        label: "BC loss",
        help: "Mean over batch and dimensions of (ε − ε_θ(a^t, s, t))² (Diffusion-QL's Eq. 2). 1 is a predictor that always says 0.",
    },
    Metric {
        name: "q_loss",
        label: "Q loss",
        help: "−mean of Q_i(s, a⁰) over the mean of |Q_j(s, a⁰)|, where the actor samples a⁰, and chance says which critic is i and which j (Diffusion-QL's Eq. 3). While the critics are alike and Q keeps its sign over the batch it is near −1 where Q is positive, near 1 where it is negative.",
    },
    Metric { name: "actor_loss", label: "", help: "(BC loss) + η·(Q loss) (Diffusion-QL's Eq. 3)." },
    Metric { name: "critic_gradient_norm", label: "", help: "Global norm of the critics' gradient before clipping." },
    Metric { name: "actor_gradient_norm", label: "", help: "Global norm of the actor's gradient before clipping." },
];

/// Diffusion-QL's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    /// Denoising steps T.
    diffusion_steps: Count,
    /// Discount γ.
    gamma: Share,
    /// Strength η of Q beside cloning.
    eta: NotNegative,
    /// Next actions sampled per next state for the target, S; of several, each critic's largest value counts.
    samples: Count,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    /// Global norm at which each network's gradient is clipped.
    gradient_clip: Positive,
    /// EMA rate of the target critics.
    ema_rate: Rate,
    /// EMA rate of the target actor.
    actor_ema_rate: Rate,
    /// The target actor follows in updates whose number, from 0, is a multiple of this …
    actor_ema_every: Steps,
    /// … and at least this.
    actor_ema_start: u64,
    /// Actions that an evaluated policy draws in each state.
    candidates: Candidates,
    /// Temperature of the softmax by which one of them is drawn, in units of Q.
    temperature: Positive,
}

/// Diffusion-QL in the middle of a run.
struct Dql {
    config: Config,
    context: Context,
    shape: DiffusionShape,
    /// ε_θ and its EMA.
    actor: Trained<NoisePredictor>,
    target_actor: NoisePredictor,
    /// Q_1 and Q_2, and their EMA Q̂.
    critics: Trained<Ensemble>,
    target_critics: Ensemble,
}

/// The random numbers of one update.
struct Noise {
    /// Of the sampled next actions, `[T, B·S, a]`.
    next: Tensor,
    /// Of the actions that are moved towards large Q, `[T, B, a]`.
    policy: Tensor,
    /// i and ε of Eq. 2.
    denoising: Denoising,
    /// The critic whose value the actor raises.
    raised: usize,
}

impl Dql {
    fn new(config: Config, context: Context) -> std::result::Result<Self, AlgorithmError> {
        let shape = DiffusionShape {
            observation_dim: context.observation_dim(),
            action_dim: context.action_dim(),
            actor: config.actor.clone(),
            critic: config.critic.clone(),
            value: None,
            critics: CRITICS,
            diffusion_steps: *config.diffusion_steps,
            reverse: Reverse::Posterior,
        };
        let (actor, target_actor) = noise_predictor(shape.actor(), 0.0, &context, 0)?;
        let critics = ensemble(shape.critics(), &context, 1)?;
        Ok(Self { actor, target_actor, target_critics: critics.network.copy()?, critics, shape, config, context })
    }

    fn noise(&self, step: u64) -> Result<Noise> {
        let mut generator = stream(self.context.seed, Purpose::Noise, step);
        let (actor, b, device) = (self.actor.network.shape(), self.context.batch_size, &self.context.device);
        Ok(Noise {
            next: chain_noise(actor, b * *self.config.samples, &mut generator, device)?,
            policy: chain_noise(actor, b, &mut generator, device)?,
            denoising: Denoising::draw(actor, b, &mut generator, device)?,
            raised: generator.random_range(0..CRITICS),
        })
    }

    /// One pass through Algorithm 1's loop; `step` counts from 0.
    fn step(&mut self, step: u64, batch: &Minibatch, noise: &Noise) -> Result<Vec<f32>> {
        let adam = |rate: f32| AdamStep { rate, clip: Some(*self.config.gradient_clip), count: step + 1 };
        let (critic_adam, actor_adam) =
            (adam(*self.config.critic_learning_rate), adam(*self.config.actor_learning_rate));

        // Q(s, a) towards r + γ·min_k Q̂_k(s', a'), Eq. 4.
        let targets = self.targets(batch, &noise.next)?;
        let error = self.critics.network.squared_error(&batch.observations, &batch.actions, &targets)?;
        let critic_loss = (error * CRITICS as f64)?;
        let critic_gradient_norm = self.critics.descend(&Gradients::of(&critic_loss)?, critic_adam)?;

        // The policy: cloned, Eq. 2, and moved towards what the critics value, Eq. 3.
        let noisy = noise.denoising.noisy(self.actor.network.schedule(), &batch.actions)?;
        let predicted = self.actor.network.predict(&batch.observations, &noisy.actions, &noisy.t)?;
        let bc_loss = mse(&predicted, &noise.denoising.epsilon)?;
        let q_loss = self.q_loss(batch, noise)?;
        let actor_loss = (&bc_loss + (&q_loss * f64::from(*self.config.eta))?)?;
        let actor_gradient_norm = self.actor.descend(&Gradients::of(&actor_loss)?, actor_adam)?;

        // Targets.
        if step.is_multiple_of(*self.config.actor_ema_every) && step >= self.config.actor_ema_start {
            self.target_actor.weights_mut().ema_update(self.actor.network.weights(), *self.config.actor_ema_rate)?;
        }
        self.target_critics.weights_mut().ema_update(self.critics.network.weights(), *self.config.ema_rate)?;

        numbers(&[
            &targets.mean_all()?,
            &critic_loss,
            &bc_loss,
            &q_loss,
            &actor_loss,
            &critic_gradient_norm,
            &actor_gradient_norm,
        ])
    }

    /// y of Eq. 4, `[B]`: of several next actions each critic takes its best, then the smaller of the critics counts.
    fn targets(&self, batch: &Minibatch, noise: &Tensor) -> Result<Tensor> {
        let next_actions = self.target_actor.sample(&batch.next_observations, noise)?;
        let q = self.target_critics.values(&batch.next_observations, &next_actions)?;
        let best = largest(&q.reshape((CRITICS, (), *self.config.samples))?, 2)?;
        batch.target(*self.config.gamma, &smaller(&best)?)
    }

    /// −E[Q_i(s, a⁰)]/E|Q_j(s, a⁰)| of actions from the whole chain, `[]`: the second term of Eq. 3, without η. Its gradient
    /// reaches the actor alone, and not by way of the divisor.
    fn q_loss(&self, batch: &Minibatch, noise: &Noise) -> Result<Tensor> {
        let actions = self.actor.network.sample_with_gradient(&batch.observations, &noise.policy)?;
        let q = self.critics.network.detach().values(&batch.observations, &actions)?;
        let (raised, other) = (q.get(noise.raised)?, q.get(1 - noise.raised)?);
        raised.mean_all()?.neg()? / other.abs()?.mean_all()?.detach()
    }
}

impl Algorithm for Dql {
    fn items(&self) -> usize {
        self.context.transitions.len()
    }

    fn update(&mut self, step: u64, items: &[u32]) -> Result<Vec<f32>> {
        let (batch, noise) = (self.context.batch(items)?, self.noise(step)?);
        self.step(step, &batch, &noise)
    }

    /// The actor as it is, not its EMA; one of its candidates is drawn by what the target critics say of them.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let tensors = DiffusionPolicy::tensors(&self.actor.network, &self.target_critics, None)?;
        let rule = Rule::Softmax { temperature: *self.config.temperature };
        let choice = Choice { candidates: *self.config.candidates, value: Reduce::Min, rule };
        Ok((PolicyConfig::Diffusion { shape: self.shape.clone(), choice }, tensors))
    }

    fn parts(&mut self) -> Parts<'_> {
        Parts::default()
            .trained("actor", &mut self.actor)
            .trained("critic", &mut self.critics)
            .weights("target_actor", self.target_actor.weights_mut())
            .weights("target_critic", self.target_critics.weights_mut())
    }
}
