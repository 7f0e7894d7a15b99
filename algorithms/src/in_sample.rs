//! What IQL and its kin share: they never ask for the value of an action that is not in the data.
//! V(s) is fitted to the target critics' smaller value, a Gaussian policy is cloned from the data
//! with weights, and twin critics move toward r + γ·V(s'). An algorithm of this kind is its
//! [`ImplicitLosses`].

use super::algorithm::{AgentError, Algorithm, Loss, Measured, measured, smaller};
use super::context::{Context, Minibatch};
use super::definition::{self, Metric, metrics};
use super::gaussian::Gaussian;
use super::hyperparameters::{Positive, Rate, UnitInterval};
use super::parts::Parts;
use super::train_state::{TrainState, ensemble};
use candle_core::{DType, Result, Tensor};
use quad_nn::{AdamStep, Ensemble, EnsembleShape, MlpConfig, Tensors, Weighted, cosine_decay};
use quad_policy::PolicyConfig;
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;
/// Largest weight of an action of the data.
const MOST_WEIGHT: f64 = 100.0;

/// What the metrics of one algorithm say of its own equations.
pub(super) struct Helps {
    pub targets: &'static str,
    pub value_loss: &'static str,
    pub critic_loss: &'static str,
    pub actor_loss: &'static str,
    pub learning_rate: &'static str,
}

/// The learning rate where it always decays.
pub(super) const COSINE: &str = "The actor's learning rate; falls to 0 along a cosine.";

/// The metrics of one algorithm.
pub(super) const fn table(helps: Helps) -> [Metric; 9] {
    metrics! {
        q_mean held_out: helps.targets;
        v_mean ["V"] held_out: "Mean over the batch of the value V(s) after its step.";
        value_loss ["value loss"] held_out: helps.value_loss;
        critic_loss ["critic loss"] held_out: helps.critic_loss;
        actor_loss ["actor loss"] held_out: helps.actor_loss;
        advantage_mean held_out: "Mean over the batch of the advantage A = min_k Q̂_k(s, a) − V(s).";
        weight_mean held_out: "Mean over the batch of the weights in the actor's loss.";
        clipped_share held_out: "UnitInterval of the batch, 0 to 1, whose weight is clipped at 100.";
        learning_rate: helps.learning_rate;
    }
}

/// The hyper-parameters that all have.
#[derive(Deserialize)]
pub(super) struct Common {
    actor: MlpConfig,
    critic: MlpConfig,
    value: MlpConfig,
    /// Discount γ.
    gamma: UnitInterval,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    value_learning_rate: Positive,
    /// EMA rate of the target critics.
    ema_rate: Rate,
}

/// Reads a table of hyper-parameters with [`Common`]'s among them.
pub(super) fn read<T: DeserializeOwned>(table: &toml::Table) -> std::result::Result<T, AgentError> {
    definition::read_with::<Common, T>(table)
}

/// The equations of one algorithm; its hyper-parameters hold them.
pub(super) trait ImplicitLosses: Send {
    fn common(&self) -> &Common;

    /// The loss `[]` that V is moved down, of `q`, the smaller Q̂(s, a), and `v`, V(s); both `[B]`.
    fn value_loss(&self, q: &Tensor, v: &Tensor) -> Result<Tensor>;

    /// The weights of actions with these advantages, `[B]`, before they are clipped at 0 and 100.
    fn weights(&self, advantages: &Tensor) -> Result<Tensor>;

    /// The loss `[]` that the critics are moved down, of `q`, Q_k(s, a), `[2, B]`, and the targets
    /// y, `[B]`.
    fn critic_loss(&self, q: &Tensor, targets: &Tensor) -> Result<Tensor> {
        q.broadcast_sub(targets)?.sqr()?.mean_all()? * CRITICS as f64
    }

    /// States and actions that V is fitted to in update number `step`, where they are not the
    /// batch's.
    fn pairs(&self, _: &Context, _step: u64, _: &Minibatch) -> Result<Option<(Tensor, Tensor)>> {
        Ok(None)
    }

    /// Steps that V makes in an update.
    fn value_steps(&self) -> u64 {
        1
    }

    /// Whether the actor's learning rate falls to 0 along a cosine, or is constant.
    fn actor_rate_decays(&self) -> bool {
        true
    }
}

/// Such an algorithm in the middle of a run.
pub(super) struct InSample<L> {
    pub losses: L,
    pub context: Context,
    /// V.
    value: TrainState<Ensemble>,
    /// Q_1 and Q_2, and their EMA Q̂.
    critics: TrainState<Ensemble>,
    target_critics: Ensemble,
    actor: Gaussian,
}

impl<L: ImplicitLosses> InSample<L> {
    pub fn new(losses: L, context: Context) -> Result<Self> {
        let (observation_dim, action_dim) = (context.observation_dim(), context.action_dim());
        let shape = |members, action_dim, layers: &MlpConfig| EnsembleShape {
            members,
            observation_dim,
            action_dim,
            layers: layers.clone(),
            outputs: 1,
        };
        let common = losses.common();
        let critics = ensemble(shape(CRITICS, action_dim, &common.critic), &context, 1)?;
        Ok(Self {
            value: ensemble(shape(1, 0, &common.value), &context, 2)?,
            target_critics: critics.network.copy()?,
            critics,
            actor: Gaussian::new(&common.actor, &context, 0)?,
            losses,
            context,
        })
    }

    /// Update number `step`; `pairs` are what [`ImplicitLosses::pairs`] gives.
    pub fn step(
        &mut self,
        step: u64,
        batch: &Minibatch,
        pairs: Option<(Tensor, Tensor)>,
    ) -> Result<Measured> {
        let common = self.losses.common();
        let q = self.q(&batch.observations, &batch.actions)?;
        let fitted = self.fitted(batch, &q, pairs)?;
        let steps = self.losses.value_steps();
        let mut value_loss = self.value_loss(&fitted)?;
        for i in 0..steps {
            if i > 0 {
                value_loss = self.value_loss(&fitted)?;
            }
            let adam = AdamStep::after(step * steps + i, *common.value_learning_rate);
            self.value.minimize(&value_loss.value, adam)?;
        }

        let actor_loss = self.actor_loss(batch, &q)?;
        let decay = if self.losses.actor_rate_decays() {
            cosine_decay(step, self.context.total_steps)
        } else {
            1.0
        };
        let rate = *common.actor_learning_rate * decay;
        self.actor.minimize(&actor_loss.value, AdamStep::after(step, rate))?;

        let critic_loss = self.critic_loss(batch)?;
        self.critics
            .minimize(&critic_loss.value, AdamStep::after(step, *common.critic_learning_rate))?;
        self.target_critics.soft_update(&self.critics.network, *common.ema_rate)?;

        let mut measured = measured(&[value_loss, actor_loss, critic_loss])?;
        measured.push(("learning_rate", rate));
        Ok(measured)
    }

    /// The smaller Q̂ of these actions, `[n]`.
    fn q(&self, states: &Tensor, actions: &Tensor) -> Result<Tensor> {
        smaller(&self.target_critics.values(states, actions)?)
    }

    /// The states that V is fitted in, and to what; `q` is the smaller Q̂ of the batch.
    fn fitted(
        &self,
        batch: &Minibatch,
        q: &Tensor,
        pairs: Option<(Tensor, Tensor)>,
    ) -> Result<(Tensor, Tensor)> {
        match pairs {
            Some((states, actions)) => Ok((states.clone(), self.q(&states, &actions)?)),
            None => Ok((batch.observations.clone(), q.clone())),
        }
    }

    /// V(s) toward the smaller Q̂(s, a).
    fn value_loss(&self, (states, q): &(Tensor, Tensor)) -> Result<Loss> {
        let loss =
            self.losses.value_loss(q, &self.value.network.state_values(states)?.squeeze(0)?)?;
        Ok(Loss::new("value_loss", loss))
    }

    /// The policy toward actions of the data, the more so the better they are.
    fn actor_loss(&self, batch: &Minibatch, q: &Tensor) -> Result<Loss> {
        let v = self.value.network.detach().state_values(&batch.observations)?.squeeze(0)?;
        let advantage = (q - &v)?;
        let weight = self.losses.weights(&advantage)?;
        let clipped = weight.gt(MOST_WEIGHT)?.to_dtype(DType::F32)?;
        let weight = weight.clamp(0.0, MOST_WEIGHT)?;
        let log_probability = self.actor.log_probability(&batch.observations, &batch.actions)?;
        Ok(Loss::new("actor_loss", (&weight * log_probability)?.mean_all()?.neg()?)
            .with("v_mean", v.mean_all()?)
            .with("advantage_mean", advantage.mean_all()?)
            .with("weight_mean", weight.mean_all()?)
            .with("clipped_share", clipped.mean_all()?))
    }

    /// Q(s, a) toward r + γ·V(s').
    fn critic_loss(&self, batch: &Minibatch) -> Result<Loss> {
        let next =
            self.value.network.detach().state_values(&batch.next_observations)?.squeeze(0)?;
        let targets = batch.target(*self.losses.common().gamma, &next)?;
        let values = self.critics.network.values(&batch.observations, &batch.actions)?;
        Ok(Loss::new("critic_loss", self.losses.critic_loss(&values, &targets)?)
            .with("q_mean", targets.mean_all()?))
    }
}

impl<L: ImplicitLosses> Algorithm for InSample<L> {
    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let batch = self.context.batch(items)?;
        let pairs = self.losses.pairs(&self.context, step, &batch)?;
        self.step(step, &batch, pairs)
    }

    fn evaluate(&self, step: u64, items: &[u32]) -> Result<Measured> {
        let batch = self.context.batch(items)?;
        let q = self.q(&batch.observations, &batch.actions)?;
        let fitted = self.fitted(&batch, &q, self.losses.pairs(&self.context, step, &batch)?)?;
        measured(&[
            self.value_loss(&fitted)?,
            self.actor_loss(&batch, &q)?,
            self.critic_loss(&batch)?,
        ])
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        self.actor.policy()
    }

    fn parts(&mut self) -> Parts<'_> {
        let parts = Parts::default()
            .trained("value", &mut self.value)
            .trained("critic", &mut self.critics)
            .weights("target_critic", self.target_critics.weights_mut());
        self.actor.parts(parts)
    }
}

/// −max(largest z of the batch, −1), `[]`, a constant: exponentials of z that are multiplied by its
/// exponential cannot overflow.
pub(super) fn scale_down(z: &Tensor) -> Result<Tensor> {
    z.max(0)?.maximum(-1.0)?.neg().map(|shift| shift.detach())
}
