//! Fitted Q evaluation (Le, Voloshin and Yue 2019, "Batch Policy Learning under Constraints"; with
//! the clipped targets of Fu et al. 2021, "Benchmarks for Deep Off-Policy Evaluation"): what a
//! policy that is given would be worth, learned from the data alone. Q moves toward r +
//! γ·mask·Q̂(s', a') with the action a' that the policy takes at s', drawn once for each s'.
//!
//! It makes no policy, so it is none of [`ALGORITHMS`](crate::ALGORITHMS): `learner judge` runs it.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/fqe.rs"]
mod golden;

use super::algorithm::{AgentError, AlgorithmError, Loss, Measured, measured};
use super::context::{Context, Minibatch};
use super::definition::read;
use super::hyperparameters::{NotNegative, Positive, Rate, UnitInterval};
use super::parts::Parts;
use super::train_state::{TrainState, initial};
use candle_core::{Device, Result, Tensor};
use quad_nn::{AdamStep, Ensemble, EnsembleShape, MlpConfig, Weighted};
use serde::Deserialize;

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
    /// Discount γ.
    gamma: UnitInterval,
    learning_rate: Positive,
    /// What each step takes off the weights, relative to them and to its rate.
    weight_decay: NotNegative,
    /// EMA rate of the target critic.
    ema_rate: Rate,
}

impl FqeConfig {
    /// The settings of google-research's policy_eval, but for a target that follows twice as fast.
    ///
    /// # Errors
    /// γ is not in [0, 1].
    pub fn with_discount(gamma: f32) -> std::result::Result<Self, AgentError> {
        let mut table: toml::Table = toml::from_str(SETTINGS)?;
        table.insert("gamma".to_owned(), f64::from(gamma).into());
        read(&table)
    }
}

/// Units of values: those of the network are so many times `scale` from `offset`. Targets stay
/// within what rewards allow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Units {
    /// Where values begin: the data's mean return from a state on.
    pub offset: f64,
    /// The standard deviation of these returns; 1 where they are all the same.
    pub scale: f64,
    /// The value of the least reward for ever, or of one of it if that is less, because an episode
    /// may terminate.
    pub least: f64,
    /// Likewise of the largest.
    pub most: f64,
}

impl Units {
    /// Those of the data's rewards.
    pub fn of(context: &Context, gamma: f64) -> Self {
        let mut batch = quad_dataset::Batch::default();
        context
            .transitions
            .gather(&Vec::from_iter(0..context.transitions.len() as u32), &mut batch);
        let mut returns: Vec<f64> = batch.rewards.iter().map(|reward| f64::from(*reward)).collect();
        for row in (0..returns.len() as u32).rev() {
            if let Some(next) = context.transitions.next(row) {
                returns[row as usize] += gamma * returns[next as usize];
            }
        }
        let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len() as f64;
        let offset = mean(&returns);
        let scale =
            mean(&Vec::from_iter(returns.iter().map(|value| (value - offset).powi(2)))).sqrt();
        let rewards = batch.rewards.iter().map(|reward| f64::from(*reward));
        let (low, high) = rewards
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), r| (low.min(r), high.max(r)));
        let forever = 1.0 / (1.0 - gamma);
        Self {
            offset,
            scale: if scale > 0.0 { scale } else { 1.0 },
            least: low.min(low * forever),
            most: high.max(high * forever),
        }
    }
}

/// An evaluation of one policy in progress.
pub struct Fqe {
    config: FqeConfig,
    units: Units,
    context: Context,
    /// The transitions to learn from.
    items: Vec<u32>,
    /// a' of each transition of the data, `[N, a]`.
    next_actions: Tensor,
    /// Q, and its EMA Q̂; both in the network's units.
    critic: TrainState<Ensemble>,
    target_critic: Ensemble,
}

impl Fqe {
    /// An evaluation at its beginning of the policy that takes these actions, `[N, a]`, after the
    /// data's N transitions.
    ///
    /// # Errors
    /// Candle fails.
    pub fn new(
        config: FqeConfig,
        units: Units,
        context: Context,
        next_actions: Vec<f32>,
    ) -> Result<Self> {
        let items = (0..context.transitions.len() as u32).collect();
        let next_actions = Tensor::from_vec(
            next_actions,
            (context.transitions.len(), context.action_dim()),
            &context.device,
        )?;
        Self::over(items, config, units, context, next_actions)
    }

    /// An evaluation of the policy that recorded the data, over the transitions after which the
    /// data says what it did.
    ///
    /// # Errors
    /// There is no such transition, or candle fails.
    pub fn of_behavior(
        config: FqeConfig,
        units: Units,
        context: Context,
    ) -> std::result::Result<Self, AlgorithmError> {
        let items = context.items_with_next_action();
        if items.is_empty() {
            return Err(AlgorithmError::NoNextAction);
        }
        let next_actions =
            context.next_actions(&Vec::from_iter(0..context.transitions.len() as u32))?;
        Ok(Self::over(items, config, units, context, next_actions)?)
    }

    fn over(
        items: Vec<u32>,
        config: FqeConfig,
        units: Units,
        context: Context,
        next_actions: Tensor,
    ) -> Result<Self> {
        let shape = EnsembleShape {
            members: 1,
            observation_dim: context.observation_dim(),
            action_dim: context.action_dim(),
            layers: config.critic.clone(),
            outputs: 1,
        };
        let network =
            Ensemble::new(shape.clone(), initial(&shape.layout(), &context, 0)?, context.precision);
        let critic = TrainState::new(network, *config.weight_decay)?;
        Ok(Self {
            target_critic: critic.network.copy()?,
            critic,
            config,
            units,
            context,
            items,
            next_actions,
        })
    }

    /// Begins with the networks of another evaluation, such as the behavior's, from whose values a
    /// policy's differ little.
    ///
    /// # Errors
    /// Candle fails.
    pub fn begin_with(&mut self, other: &Fqe) -> Result<()> {
        self.critic.network.soft_update(&other.critic.network, 1.0)?;
        self.target_critic.soft_update(&other.target_critic, 1.0)
    }

    /// How many items updates draw from.
    pub fn items(&self) -> usize {
        self.items.len()
    }

    /// Update number `step`, from 0, on the items of these numbers. Measures `critic_loss`, the
    /// mean over the batch of (Q(s, a) − y)² in the network's units, and `q_mean`, the mean of the
    /// targets y in the rewards'.
    ///
    /// # Errors
    /// Candle fails.
    pub fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let rows: Vec<u32> = items.iter().map(|item| self.items[*item as usize]).collect();
        let batch = self.context.batch(&rows)?;
        let next_actions = self
            .next_actions
            .index_select(&Tensor::from_vec(rows, items.len(), &self.context.device)?, 0)?;
        let targets = self.targets(&batch, &next_actions)?;
        let of_network =
            targets.affine(1.0 / self.units.scale, -self.units.offset / self.units.scale)?;
        let loss =
            self.critic.network.squared_error(&batch.observations, &batch.actions, &of_network)?;
        let loss = Loss::new("critic_loss", loss).with("q_mean", targets.mean_all()?);
        self.critic.minimize(&loss.value, AdamStep::after(step, *self.config.learning_rate))?;
        self.target_critic.soft_update(&self.critic.network, *self.config.ema_rate)?;
        measured(&[loss])
    }

    /// y = r + γ·mask·Q̂(s', a'), at most and at least what rewards allow; `[B]`.
    fn targets(&self, batch: &Minibatch, next_actions: &Tensor) -> Result<Tensor> {
        let next = self.target_critic.values(&batch.next_observations, next_actions)?.squeeze(0)?;
        let next = next.affine(self.units.scale, self.units.offset)?;
        batch
            .target(*self.config.gamma, &next)?
            .clamp(self.units.least as f32, self.units.most as f32)
    }

    /// Q̂ of some actions `[n, a]`, each in a state of its own, `[n, o]`, in the rewards' units.
    ///
    /// # Errors
    /// Candle fails.
    pub fn values(&self, observations: &[f32], actions: &[f32]) -> Result<Vec<f32>> {
        let n = actions.len() / self.context.action_dim();
        let rows = |numbers: &[f32]| {
            Tensor::from_slice(numbers, (n, numbers.len() / n), &self.context.device)
        };
        let values =
            self.target_critic.values(&rows(observations)?, &rows(actions)?)?.squeeze(0)?;
        values.affine(self.units.scale, self.units.offset)?.to_device(&Device::Cpu)?.to_vec1()
    }

    /// Everything that updates change, by name.
    pub fn parts(&mut self) -> Parts<'_> {
        Parts::default()
            .trained("critic", &mut self.critic)
            .weights("target_critic", self.target_critic.weights_mut())
    }
}
