//! What TD3+BC and ReBRAC share: TD3 (Fujimoto, van Hoof and Meger 2018), whose deterministic
//! policy also stays near the data's actions. Critics move in every step, the policy and the
//! targets in every second or so. An algorithm of this kind is its [`BcRegularizer`].

use super::algorithm::{
    AgentError, Algorithm, AlgorithmError, Loss, Measured, joined, measured, smaller,
};
use super::context::{Context, Minibatch};
use super::definition;
use super::denoising::normal;
use super::hyperparameters::{NotNegative, Positive, Rate, Steps, UnitInterval};
use super::parts::{Parts, write};
use super::random::{Purpose, stream};
use super::train_state::{TrainState, ensemble};
use candle_core::{DType, Result, Tensor};
use quad_nn::{AdamStep, Ensemble, EnsembleShape, MlpConfig, Tensors, Weighted};
use quad_policy::{GaussianPolicy, GaussianShape, PolicyConfig, gaussian_mean};
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;

/// The hyper-parameters that both have.
#[derive(Deserialize)]
pub(super) struct Common {
    actor: MlpConfig,
    critic: MlpConfig,
    /// Discount γ.
    gamma: UnitInterval,
    /// Standard deviation of the noise in the targets' actions, and its largest size.
    target_noise: NotNegative,
    target_noise_limit: NotNegative,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    /// EMA rate of the target networks.
    ema_rate: Rate,
    /// Policy and targets move in every so many steps.
    actor_every: Steps,
}

/// Reads a table of hyper-parameters with [`Common`]'s among them.
pub(super) fn read<T: DeserializeOwned>(table: &toml::Table) -> std::result::Result<T, AgentError> {
    definition::read_with::<Common, T>(table)
}

/// How one algorithm keeps its policy near the data's actions; its hyper-parameters hold it.
pub(super) trait BcRegularizer: Send {
    /// The first step in which the policy moves.
    const FIRST: u64;
    /// Whether the target policy follows the policy that was there before its step.
    const LAGS: bool;

    fn common(&self) -> &Common;

    /// What the squared distance between next actions and those of the data costs in the critics'
    /// target, if anything.
    fn penalty(&self) -> Option<f32> {
        None
    }

    /// The loss `[]` of the policy's actions, `[B, a]`, whose values are `q`, `[2, B]`; and the
    /// part of it that keeps them near the data's.
    fn actor_loss(&self, actions: &Tensor, of_data: &Tensor, q: &Tensor) -> Result<[Tensor; 2]>;
}

/// Such an algorithm in the middle of a run.
pub(super) struct Td3<N> {
    near: N,
    pub context: Context,
    /// The transitions to learn from, where not all are.
    items: Option<Vec<u32>>,
    /// π is the tanh of this.
    actor: TrainState<Ensemble>,
    target_actor: Ensemble,
    critics: TrainState<Ensemble>,
    target_critics: Ensemble,
    /// What the policy's last step measured: `actor_loss` and `bc_loss`.
    of_actor: Tensor,
}

impl<N: BcRegularizer> Td3<N> {
    pub fn new(near: N, context: Context) -> std::result::Result<Self, AlgorithmError> {
        let items = near.penalty().map(|_| context.items_with_next_action());
        if items.as_ref().is_some_and(Vec::is_empty) {
            return Err(AlgorithmError::NoNextAction);
        }
        let shape = EnsembleShape {
            members: CRITICS,
            observation_dim: context.observation_dim(),
            action_dim: context.action_dim(),
            layers: near.common().critic.clone(),
            outputs: 1,
        };
        let actor = ensemble(actor_shape(near.common(), &context).actor(), &context, 0)?;
        let critics = ensemble(shape, &context, 1)?;
        Ok(Self {
            target_actor: actor.network.copy()?,
            target_critics: critics.network.copy()?,
            of_actor: Tensor::zeros(2, DType::F32, &context.device)?,
            actor,
            critics,
            items,
            near,
            context,
        })
    }

    /// Update number `step`, with standard normal noise of the targets' actions, `[B, a]`, and the
    /// data's next actions, where they count.
    pub fn step(
        &mut self,
        step: u64,
        batch: &Minibatch,
        noise: &Tensor,
        next: Option<&Tensor>,
    ) -> Result<Measured> {
        let Common { actor_every, ema_rate, actor_learning_rate, critic_learning_rate, .. } =
            self.near.common();
        let mut losses = vec![self.critic_loss(batch, noise, next)?];
        self.critics.minimize(&losses[0].value, AdamStep::after(step, **critic_learning_rate))?;
        let first = N::FIRST % **actor_every;
        if step % **actor_every == first {
            let [actor_loss, bc_loss] = self.actor_losses(batch)?;
            if N::LAGS {
                self.target_actor.soft_update(&self.actor.network, **ema_rate)?;
            }
            self.actor.minimize(
                &actor_loss,
                AdamStep::after(step / **actor_every, **actor_learning_rate),
            )?;
            if !N::LAGS {
                self.target_actor.soft_update(&self.actor.network, **ema_rate)?;
            }
            self.target_critics.soft_update(&self.critics.network, **ema_rate)?;
            write(&self.of_actor, &joined(&[&actor_loss, &bc_loss])?.detach())?;
        }
        if step >= first {
            losses.push(
                Loss::new("actor_loss", self.of_actor.get(0)?)
                    .with("bc_loss", self.of_actor.get(1)?),
            );
        }
        measured(&losses)
    }

    fn critic_loss(
        &self,
        batch: &Minibatch,
        noise: &Tensor,
        next: Option<&Tensor>,
    ) -> Result<Loss> {
        let targets = self.targets(batch, noise, next)?;
        let loss =
            self.critics.network.squared_error(&batch.observations, &batch.actions, &targets)?;
        Ok(Loss::new("critic_loss", (loss * CRITICS as f64)?).with("q_mean", targets.mean_all()?))
    }

    /// What [`BcRegularizer::actor_loss`] gives.
    fn actor_losses(&self, batch: &Minibatch) -> Result<[Tensor; 2]> {
        let actions = gaussian_mean(&self.actor.network, &batch.observations)?;
        let q = self.critics.network.detach().values(&batch.observations, &actions)?;
        self.near.actor_loss(&actions, &batch.actions, &q)
    }

    /// The batch of some items, noise and next actions, as [`Self::step`] takes them.
    fn inputs(&self, step: u64, items: &[u32]) -> Result<(Minibatch, Tensor, Option<Tensor>)> {
        let generator = &mut stream(self.context.seed, Purpose::Noise, step);
        let noise = normal(
            (self.context.batch_size, self.context.action_dim()),
            generator,
            &self.context.device,
        )?;
        let Some(rows) = &self.items else { return Ok((self.context.batch(items)?, noise, None)) };
        let rows: Vec<u32> = items.iter().map(|item| rows[*item as usize]).collect();
        Ok((self.context.batch(&rows)?, noise, Some(self.context.next_actions(&rows)?)))
    }

    /// y = r + γ·mask·(min_k Q̂_k(s', ã') − penalty·Σ (ã' − a')²), `[B]`, with the data's next
    /// action a'.
    fn targets(&self, batch: &Minibatch, noise: &Tensor, next: Option<&Tensor>) -> Result<Tensor> {
        let Common { gamma, target_noise, target_noise_limit, .. } = self.near.common();
        let limit = f64::from(**target_noise_limit);
        let noise = (noise * f64::from(**target_noise))?.clamp(-limit, limit)?;
        let actions = (gaussian_mean(&self.target_actor, &batch.next_observations)? + noise)?
            .clamp(-1.0, 1.0)?;
        let mut q = smaller(&self.target_critics.values(&batch.next_observations, &actions)?)?;
        if let (Some(penalty), Some(next)) = (self.near.penalty(), next) {
            q = (q - ((actions - next)?.sqr()?.sum(1)? * f64::from(penalty))?)?;
        }
        batch.target(**gamma, &q)
    }
}

fn actor_shape(common: &Common, context: &Context) -> GaussianShape {
    let (observation_dim, action_dim) = (context.observation_dim(), context.action_dim());
    GaussianShape { observation_dim, action_dim, actor: common.actor.clone() }
}

impl<N: BcRegularizer> Algorithm for Td3<N> {
    fn items(&self, transitions: usize) -> usize {
        self.items.as_ref().map_or(transitions, Vec::len)
    }

    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, noise, next) = self.inputs(step, items)?;
        self.step(step, &batch, &noise, next.as_ref())
    }

    fn evaluate(&self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, noise, next) = self.inputs(step, items)?;
        let [actor_loss, bc_loss] = self.actor_losses(&batch)?;
        let critic_loss = self.critic_loss(&batch, &noise, next.as_ref())?;
        measured(&[critic_loss, Loss::new("actor_loss", actor_loss).with("bc_loss", bc_loss)])
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let shape = actor_shape(self.near.common(), &self.context);
        Ok((PolicyConfig::Gaussian { shape }, GaussianPolicy::tensors(&self.actor.network)?))
    }

    fn parts(&mut self) -> Parts<'_> {
        Parts::default()
            .trained("actor", &mut self.actor)
            .weights("target_actor", self.target_actor.weights_mut())
            .trained("critic", &mut self.critics)
            .weights("target_critic", self.target_critics.weights_mut())
            .number("of_actor", &mut self.of_actor)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
pub(super) mod golden {
    use super::*;
    use crate::golden::{Golden, batch, check_actions, check_update, context, load, table};
    use candle_core::Device;

    /// Checks an update against a golden folder.
    pub fn check<N: BcRegularizer + DeserializeOwned>(
        golden: &Golden,
        device: &Device,
        metrics: &[definition::Metric],
    ) {
        let near = read::<N>(&table(golden)).unwrap();
        let next = near.penalty().map(|_| golden.input("next_actions", device));
        let mut td3 = Td3::new(near, context(golden, device)).unwrap();
        load(golden, td3.parts());
        check_actions(golden, &td3);
        let (batch, step) = (batch(golden, &td3.context), golden.count("/step") as u64);
        let measured =
            td3.step(step, &batch, &golden.input("target_noise", device), next.as_ref()).unwrap();
        check_update(golden, metrics, &measured, td3.parts().save().unwrap());
    }
}
