//! Fitted Q evaluation (Le, Voloshin and Yue 2019, "Batch Policy Learning under Constraints"; with
//! the clipped targets of Fu et al. 2021, "Benchmarks for Deep Off-Policy Evaluation"): the value of
//! a given policy, learned from the data alone. Q moves toward r + γ·mask·Q̂(s', a') with the action
//! a' that the policy takes at s', drawn once for each s'.
//!
//! It makes no policy, so it is not among [`ALGORITHMS`](crate::ALGORITHMS): `learner judge` runs it.

#[cfg(test)]
mod tests;

use super::batch::asked;
use super::examples::episode_rewards;
use super::prelude::*;
use super::returns::discounted;
use quad_dataset::Transitions;

const SETTINGS: &str = "
critic = { hidden = [256, 256], activation = \"relu\" }
learning_rate = 3e-4
weight_decay = 1e-5
ema_rate = 1e-2
";

/// Settings of the evaluation.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FqeConfig {
    critic: MlpConfig,
    gamma: UnitInterval,
    learning_rate: Positive,
    /// Share of the learning rate by which each step shrinks the weights.
    weight_decay: NotNegative,
    ema_rate: Rate,
}

impl FqeConfig {
    /// The settings of google-research's policy_eval, but for an EMA rate twice as large.
    ///
    /// # Errors
    /// γ is not in [0, 1].
    pub fn with_discount(gamma: f32) -> std::result::Result<Self, AgentError> {
        let mut table: toml::Table = toml::from_str(SETTINGS)?;
        table.insert("gamma".to_owned(), f64::from(gamma).into());
        read(&table)
    }
}

/// Units of the network, whose value is (value − offset)/scale, and bounds of the targets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Units {
    /// The data's mean return from a state on.
    pub offset: f64,
    /// The standard deviation of these returns; 1 if they are all the same.
    pub scale: f64,
    /// The smallest possible return: the least reward forever or, if that is less, once, as an
    /// episode may terminate.
    pub least: f64,
    /// The largest possible return: the largest reward forever or, if that is more, once.
    pub most: f64,
}

impl Units {
    /// The units and bounds of the data's rewards.
    pub fn new(transitions: &Transitions, gamma: f64) -> Self {
        let (mut returns, mut low, mut high) = (Vec::new(), f64::INFINITY, f64::NEG_INFINITY);
        for episode in transitions.episodes() {
            let (rewards, _) = episode_rewards(transitions, episode);
            returns.extend(discounted(&rewards, gamma, 0.0));
            for reward in rewards.into_iter().map(f64::from) {
                (low, high) = (low.min(reward), high.max(reward));
            }
        }
        let mean = |numbers: &[f64]| numbers.iter().sum::<f64>() / numbers.len() as f64;
        let offset = mean(&returns);
        let squares = Vec::from_iter(returns.iter().map(|value| (value - offset).powi(2)));
        let scale = mean(&squares).sqrt();
        let forever = 1.0 / (1.0 - gamma);
        Self {
            offset,
            scale: if scale > 0.0 { scale } else { 1.0 },
            least: low.min(low * forever),
            most: high.max(high * forever),
        }
    }
}

networks! {
    /// Q in the network's units.
    struct Networks(config: &FqeConfig, init) {
        critic: WithTarget<Ensemble> = init.critics(1, &config.critic),
    }
}

/// An evaluation of one policy in progress.
pub struct Fqe {
    config: FqeConfig,
    units: Units,
    context: Context,
    networks: Networks,
}

impl Fqe {
    /// An evaluation at step 0.
    ///
    /// # Errors
    /// Candle fails.
    pub fn new(config: FqeConfig, units: Units, context: Context) -> Result<Self> {
        let mut networks = Networks::new(&config, &mut Initializer::new(&context))?;
        networks.critic.decay_weights(*config.weight_decay)?;
        Ok(Self { config, units, context, networks })
    }

    /// Takes the networks of another evaluation, such as the behavior's, from whose values a policy's
    /// differ little.
    pub fn begin_with(&mut self, other: &Fqe) -> Result<()> {
        let (critic, other) = (&mut self.networks.critic, &other.networks.critic);
        critic.network.soft_update(&other.network, 1.0)?;
        critic.target.soft_update(&other.target, 1.0)
    }

    /// Performs update number `step`, from 0, on a batch with the policy's next actions. Measures
    /// `critic_loss`, the mean over the batch of (Q(s, a) − y)² in the network's units, and
    /// `target_q_mean`, the mean of the targets y in the rewards'.
    pub fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let targets = self.targets(batch)?;
        let scaled =
            targets.affine(1.0 / self.units.scale, -self.units.offset / self.units.scale)?;
        let critic = &mut self.networks.critic;
        let loss = batch.squared_error(critic, &scaled)?;
        critic.minimize(&loss, AdamStep::after(step, *self.config.learning_rate))?;
        critic.soft_update(*self.config.ema_rate)?;
        measured(&[Loss::critics(loss, &targets)?])
    }

    /// y = r + γ·mask·Q̂(s', a'), clipped to the bounds of the units; `[B]`.
    fn targets(&self, batch: &Batch) -> Result<Tensor> {
        let critic = &self.networks.critic.target;
        let next = batch.next_values(critic, asked(&batch.next_actions)?)?.squeeze(0)?;
        let next = next.affine(self.units.scale, self.units.offset)?;
        batch
            .target(*self.config.gamma, &next)?
            .clamp(self.units.least as f32, self.units.most as f32)
    }

    /// Q̂ of n observations and actions, `[n, o]` and `[n, a]`, in the rewards' units.
    pub fn values(&self, observations: &[f32], actions: &[f32]) -> Result<Vec<f32>> {
        let n = actions.len() / self.context.action_dim();
        let rows = |numbers: &[f32]| {
            Tensor::from_slice(numbers, (n, numbers.len() / n), &self.context.device)
        };
        let critic = &self.networks.critic.target;
        let values = critic.values(&rows(observations)?, &rows(actions)?)?;
        let values = values.affine(self.units.scale, self.units.offset)?;
        values.squeeze(0)?.to_device(&Device::Cpu)?.to_vec1()
    }

    /// Everything that updates change.
    pub fn state_dict(&mut self) -> StateDict<'_> {
        self.networks.state_dict()
    }
}
