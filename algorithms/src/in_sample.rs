//! IQL and its relatives, which never evaluate an action that is not in the data: V(s) is fitted to
//! the target critics' smaller value, a Gaussian policy is cloned from the data with weights, and
//! twin critics move toward r + γ·V(s'). An algorithm of this kind is an [`ImplicitLosses`].

use super::gaussian::Gaussian;
use super::prelude::*;

/// Largest weight of an action of the data.
const MOST_WEIGHT: f64 = 100.0;

/// The help of the metrics whose equations differ between these algorithms.
pub(super) struct Helps {
    pub targets: &'static str,
    pub value_loss: &'static str,
    pub critic_loss: &'static str,
    pub actor_loss: &'static str,
    pub learning_rate: &'static str,
}

/// The help of a learning rate that always decays.
pub(super) const COSINE: &str =
    "The actor's learning rate; falls to 0 along a cosine, and is constant online.";

/// The metrics of one algorithm.
pub(super) const fn table(helps: Helps) -> [Metric; 9] {
    metrics! {
        target_q_mean held_out: helps.targets;
        v_mean ["V"] held_out: "Mean over the batch of the value V(s) after its step.";
        value_loss ["value loss"] held_out: helps.value_loss;
        critic_loss ["critic loss"] held_out: helps.critic_loss;
        actor_loss ["actor loss"] held_out: helps.actor_loss;
        advantage_mean held_out: "Mean over the batch of the advantage A = min_k Q̂_k(s, a) − V(s).";
        weight_mean held_out: "Mean over the batch of the weights in the actor's loss.";
        clipped_share held_out: "Share of the batch, 0 to 1, whose weight is clipped at 100.";
        learning_rate: helps.learning_rate;
    }
}

/// The hyper-parameters that all algorithms of this kind have.
#[derive(Clone, Deserialize)]
pub(super) struct Common {
    actor: MlpConfig,
    critic: MlpConfig,
    value: MlpConfig,
    gamma: UnitInterval,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    value_learning_rate: Positive,
    ema_rate: Rate,
}

/// The hyper-parameters and equations of an algorithm.
pub(super) trait ImplicitLosses: Send {
    fn common(&self) -> &Common;

    /// V's loss `[]` of `q`, the smaller Q̂(s, a), and `v`, V(s); both `[B]`.
    fn value_loss(&self, q: &Tensor, v: &Tensor) -> Result<Tensor>;

    /// The weights of actions with these advantages, `[B]`, before they are clipped at 0 and 100.
    fn weights(&self, advantages: &Tensor) -> Result<Tensor>;

    /// The critics' loss `[]` of `q`, Q_k(s, a), `[2, B]`, and the targets y, `[B]`.
    fn critic_loss(&self, q: &Tensor, targets: &Tensor) -> Result<Tensor> {
        q.broadcast_sub(targets)?.sqr()?.mean_all()? * TWIN as f64
    }

    /// The states and actions that V is fitted to in update number `step`, if they are not the
    /// batch's.
    fn pairs(&self, _: &Context, _step: u64, _: &Batch) -> Result<Option<(Tensor, Tensor)>> {
        Ok(None)
    }

    /// V's steps per update.
    fn value_steps(&self) -> u64 {
        1
    }

    /// The actor's learning rate falls to 0 along a cosine before online learning.
    fn actor_rate_decays(&self) -> bool {
        true
    }
}

networks! {
    pub(super) struct Networks(config: &Common, init) {
        actor: Gaussian = Gaussian::new(&config.actor, init),
        critic: WithTarget<Ensemble> = init.critics(TWIN, &config.critic),
        value: TrainState<Ensemble> = init.value(&config.value),
    }
}

pub(super) struct InSample<L> {
    losses: L,
    context: Context,
    networks: Networks,
}

impl<L: ImplicitLosses> InSample<L> {
    pub fn new(losses: L, context: Context) -> Result<Self> {
        let networks = Networks::new(losses.common(), &mut Initializer::new(&context))?;
        Ok(Self { losses, context, networks })
    }

    /// The smaller Q̂(s, a) of the batch, and the states and values that V is fitted to; `[n]`.
    fn q(&self, step: u64, batch: &Batch) -> Result<(Tensor, (Tensor, Tensor))> {
        let critics = &self.networks.critic.target;
        let q = smallest(&batch.values(critics)?)?;
        let fitted = match self.losses.pairs(&self.context, step, batch)? {
            Some((states, actions)) => {
                let q = smallest(&critics.values(&states, &actions)?)?;
                (states, q)
            }
            None => (batch.observations.clone(), q.clone()),
        };
        Ok((q, fitted))
    }

    /// V(s) toward the smaller Q̂(s, a).
    fn value_loss(&self, (states, q): &(Tensor, Tensor)) -> Result<Loss> {
        let v = state_value(&self.networks.value, states)?;
        Ok(Loss::new("value_loss", self.losses.value_loss(q, &v)?))
    }

    /// The policy toward actions of the data, the more so the better they are.
    fn actor_loss(&self, batch: &Batch, q: &Tensor) -> Result<Loss> {
        let networks = &self.networks;
        let v = state_value(&networks.value.detach(), &batch.observations)?;
        let advantage = (q - &v)?;
        let log_probability =
            networks.actor.log_probability(&batch.observations, &batch.actions)?;
        let loss = weighted(&self.losses.weights(&advantage)?, &log_probability)?;
        Ok(loss.with("v_mean", v.mean_all()?).with("advantage_mean", advantage.mean_all()?))
    }

    /// Q(s, a) toward r + γ·V(s').
    fn critic_loss(&self, batch: &Batch) -> Result<Loss> {
        let networks = &self.networks;
        let next = state_value(&networks.value.detach(), &batch.next_observations)?;
        let targets = batch.target(*self.losses.common().gamma, &next)?;
        let loss = self.losses.critic_loss(&batch.values(&networks.critic)?, &targets)?;
        Loss::critics(loss, &targets)
    }
}

/// −mean of weight·log π(a|s), the weights `[B]` clipped at 0 and 100.
pub(super) fn weighted(weight: &Tensor, log_probability: &Tensor) -> Result<Loss> {
    let clipped = weight.gt(MOST_WEIGHT)?.to_dtype(DType::F32)?;
    let weight = weight.clamp(0.0, MOST_WEIGHT)?;
    Ok(Loss::new("actor_loss", (&weight * log_probability)?.mean_all()?.neg()?)
        .with("weight_mean", weight.mean_all()?)
        .with("clipped_share", clipped.mean_all()?))
}

impl<L: ImplicitLosses> Algorithm for InSample<L> {
    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let (q, fitted) = self.q(step, batch)?;
        let steps = self.losses.value_steps();
        let mut value_loss = self.value_loss(&fitted)?;
        for i in 0..steps {
            if i > 0 {
                value_loss = self.value_loss(&fitted)?;
            }
            let rate = *self.losses.common().value_learning_rate;
            let adam = AdamStep::after(step * steps + i, rate);
            self.networks.value.minimize(&value_loss.value, adam)?;
        }

        let actor_loss = self.actor_loss(batch, &q)?;
        let decays = self.losses.actor_rate_decays();
        let decay = if decays { self.context.decay(step, 1.0) } else { 1.0 };
        let common = self.losses.common();
        let rate = *common.actor_learning_rate * decay;
        self.networks.actor.minimize(&actor_loss.value, AdamStep::after(step, rate))?;

        let critic_loss = self.critic_loss(batch)?;
        let adam = AdamStep::after(step, *common.critic_learning_rate);
        self.networks.critic.minimize(&critic_loss.value, adam)?;
        self.networks.critic.soft_update(*common.ema_rate)?;

        let mut measured = measured(&[value_loss, actor_loss, critic_loss])?;
        measured.push(("learning_rate", rate));
        Ok(measured)
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        let (q, fitted) = self.q(step, batch)?;
        measured(&[
            self.value_loss(&fitted)?,
            self.actor_loss(batch, &q)?,
            self.critic_loss(batch)?,
        ])
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        self.networks.actor.policy()
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks.state_dict()
    }
}

/// −max(largest z of the batch, −1), `[]`, a constant: exponentials of z that are multiplied by its
/// exponential cannot overflow.
pub(super) fn scale_down(z: &Tensor) -> Result<Tensor> {
    z.max(0)?.maximum(-1.0)?.neg().map(|shift| shift.detach())
}
