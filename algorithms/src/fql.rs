//! FQL (Park, Li and Levine 2025, "Flow Q-Learning"): a flow clones the data, and a policy of one
//! step is distilled from it while it climbs the critics. No gradient passes through the flow's
//! steps. Its update is its authors' code's; equations are that paper's.

use super::prelude::*;
use quad_policy::{ActorCriticShape, FlowActor, OneStepActor, flow_velocity};
use rand::Rng;

pub(super) const DEFINITION: Definition = Definition {
    name: "fql",
    presets: include_str!("../../presets/fql.toml"),
    metrics: METRICS,
    chunks: true,
    read: |table| Ok(start(read(table)?, Fql::new)),
    ..Definition::PLAIN
};

const METRICS: &[Metric] = &metrics! {
    target_q_mean ["Q"] held_out: "Mean over the batch of the critics' target y = r + γ·mask·(mean or smaller of Q̂_k(s', a')), where a' is the one-step policy's action, clipped.";
    critic_loss ["critic loss"] held_out: "Mean over batch and critics of (Q_k(s, a) − y)² (FQL's Eq. 3).";
    bc_loss ["BC loss"] held_out: "The flow's loss: mean over batch and dimensions of (v(s, x_t, t) − (a − x_0))² (FQL's Eq. 4).";
    distill_loss held_out: "Mean over batch and dimensions of the squared distance between the one-step policy's action, not clipped, and the flow's of the same noise (FQL's Eq. 6).";
    q_loss held_out: "−Mean over batch and critics of Q_k(s, π(s, z)), the action clipped; divided by the mean size of the mean over critics with normalize_q.";
    actor_loss ["actor loss"] held_out: "alpha·distill_loss + q_loss (FQL's Eq. 7).";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// The hidden layers of the flow's velocity, and of the one-step policy.
    actor: MlpConfig,
    critic: MlpConfig,
    gamma: UnitInterval,
    /// Reduction of the two critics' values in their target.
    target: Aggregate,
    /// Weight α of the distance between the one-step policy and the flow.
    alpha: Positive,
    /// Divide Q by its mean size in the policy's loss.
    normalize_q: bool,
    /// Euler steps of the flow.
    flow_steps: Count,
    learning_rate: Positive,
    ema_rate: Rate,
    /// Actions drawn to choose from, N_a; its authors take one.
    candidates: Candidates,
}

networks! {
    struct Fql(config: Config, init) {
        /// The one-step policy π(s, z).
        actor: TrainState<Ensemble> = init.ensemble(EnsembleShape {
            outputs: init.context.action_dim(),
            ..init.shape(&config.actor)
        }),
        critic: WithTarget<Ensemble> = init.critics(TWIN, &config.critic),
        /// The velocity v(s, x, t).
        flow: TrainState<Ensemble> = flow(&config.actor, init),
    }
}

impl Fql {
    /// The losses of critics, flow and policy.
    fn losses(&self, step: u64, batch: &Batch) -> Result<[Loss; 3]> {
        let random = &mut self.context.random(step);
        let (b, a) = batch.actions.dims2()?;
        let start = random.normal("start_noise", (b, a))?; // x_0
        let policy_noise = random.normal("policy_noise", (b, a))?;
        let next_noise = random.normal("next_noise", (b, a))?;
        let times = random.tensor("times", (b, 1), |generator| generator.random::<f32>())?;
        let targets = self.targets(batch, &next_noise)?;
        let critic_loss = batch.critic_loss(&self.critic, &targets)?;
        let bc_loss = flow_loss(&self.flow, batch, &start, &times)?;
        let [distill_loss, q_loss] = self.actor_losses(batch, &policy_noise)?;
        let actor_loss = ((&distill_loss * f64::from(*self.config.alpha))? + &q_loss)?;
        let actor_loss = Loss::new("actor_loss", actor_loss).with("distill_loss", distill_loss);
        Ok([critic_loss, Loss::new("bc_loss", bc_loss), actor_loss.with("q_loss", q_loss)])
    }

    /// y = r + γ·mask·Q̂(s', π(s', z)), `[B]`.
    fn targets(&self, batch: &Batch, noise: &Tensor) -> Result<Tensor> {
        let actions =
            OneStepActor::new(self.actor.detach()).sample(&batch.next_observations, noise)?;
        let values = batch.next_values(&self.critic.target, &actions)?;
        batch.target(*self.config.gamma, &reduced(&values, self.config.target)?)
    }

    /// The squared distance of the one-step policy's actions to the flow's, and −Q of these actions,
    /// divided by the mean of |Q| with `normalize_q`; both `[]`.
    fn actor_losses(&self, batch: &Batch, noise: &Tensor) -> Result<[Tensor; 2]> {
        let observations = &batch.observations;
        let actions = self.actor.outputs(observations, noise)?.squeeze(0)?;
        let flow = FlowActor::new(self.flow.detach(), *self.config.flow_steps);
        let distill_loss = squared_error(&actions, &flow.sample(observations, noise)?)?;
        let actions = actions.clamp(-1f32, 1f32)?;
        let q = batch.values_at(&self.critic.detach(), &actions)?.mean(0)?;
        let mut q_loss = q.mean_all()?.neg()?;
        if self.config.normalize_q {
            q_loss = (q_loss / q.detach().abs()?.mean_all()?)?;
        }
        Ok([distill_loss, q_loss])
    }
}

/// A flow's velocity, a network of s and [x, t].
pub(super) fn flow(layers: &MlpConfig, init: &mut Initializer) -> Result<TrainState<Ensemble>> {
    let a = init.context.action_dim();
    init.ensemble(EnsembleShape { action_dim: a + 1, outputs: a, ..init.shape(layers) })
}

/// Mean of (v(s, x_t, t) − (a − x_0))², `[]`, with x_t = x_0 + t·(a − x_0) (FQL's Eq. 4).
pub(super) fn flow_loss(
    flow: &Ensemble,
    batch: &Batch,
    start: &Tensor,
    times: &Tensor,
) -> Result<Tensor> {
    let velocity = (&batch.actions - start)?;
    let x = (start + velocity.broadcast_mul(times)?)?;
    let predicted = flow_velocity(flow, &batch.observations, &x, times)?;
    squared_error(&batch.within_episodes(predicted, &velocity)?, &velocity)
}

impl Algorithm for Fql {
    /// All losses are those of the networks before the update, and so are the critics that the
    /// targets follow.
    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let adam = AdamStep::after(step, *self.config.learning_rate);
        let losses = self.losses(step, batch)?;
        let [critic_loss, bc_loss, actor_loss] = &losses;
        // The policy's gradient, by the critics as they are before their step.
        let gradients = Gradients::backward(&actor_loss.value)?;
        self.critic.soft_update(*self.config.ema_rate)?;
        self.critic.minimize(&critic_loss.value, adam)?;
        self.flow.minimize(&bc_loss.value, adam)?;
        self.actor.apply_gradients(&gradients, adam)?;
        measured(&losses)
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        measured(&self.losses(step, batch)?)
    }

    /// The one-step policy, which chooses by the target critics.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let choice = Choice::new(*self.config.candidates, self.config.target, Rule::Best);
        let (actor, critics) = (&self.actor, &self.critic.target);
        let (shape, tensors) = ActorCriticShape::from_networks(actor, critics)?;
        Ok((PolicyConfig::OneStep { shape, choice }, tensors))
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks()
    }
}
