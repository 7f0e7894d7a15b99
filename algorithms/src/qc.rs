//! QC (Li, Zhou and Levine 2025, "Reinforcement Learning with Action Chunking"): a flow clones chunks
//! of the data's actions, and of what it draws the critics choose, in their targets as when the
//! policy acts. Its update is its authors' code's, but for windows that reach beyond the end of an
//! episode. QC-FQL is FQL with chunks.

use super::fql::{flow, flow_loss};
use super::prelude::*;
use quad_policy::{ActorCriticShape, FlowActor};
use rand::Rng;

pub(super) const DEFINITION: Definition = Definition {
    name: "qc",
    presets: include_str!("../../presets/qc.toml"),
    metrics: METRICS,
    chunks: true,
    read: |table| Ok(start(read(table)?, Qc::new)),
    ..Definition::PLAIN
};

const METRICS: &[Metric] = &metrics! {
    target_q_mean ["Q"] held_out: "Mean over the batch of the critics' target y = Σ_i γ^i·r_i + γ^h·mask·(mean or smaller of Q̂_k(s', a')), where a' is the best by Q of the chunks that the flow draws in s', h steps later.";
    critic_loss ["critic loss"] held_out: "Mean over batch and critics of (Q_k(s, a) − y)², where a is a chunk.";
    bc_loss ["BC loss"] held_out: "The flow's loss: mean over batch and numbers of a chunk of (v(s, x_t, t) − (a − x_0))², 0 for actions beyond the end of an episode.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// The hidden layers of the flow's velocity.
    actor: MlpConfig,
    critic: MlpConfig,
    gamma: UnitInterval,
    /// Reduction of the two critics' values, in their target and for the choice.
    target: Aggregate,
    /// Euler steps of the flow.
    flow_steps: Count,
    learning_rate: Positive,
    ema_rate: Rate,
    /// Chunks drawn to choose from, N, in targets too.
    candidates: Candidates,
}

networks! {
    struct Qc(config: Config, init) {
        critic: WithTarget<Ensemble> = init.critics(TWIN, &config.critic),
        /// The velocity v(s, x, t).
        flow: TrainState<Ensemble> = flow(&config.actor, init),
    }
}

impl Qc {
    /// The losses of critics and flow.
    fn losses(&self, step: u64, batch: &Batch) -> Result<[Loss; 2]> {
        let random = &mut self.context.random(step);
        let (b, a) = batch.actions.dims2()?;
        let start = random.normal("start_noise", (b, a))?; // x_0
        let next_noise = random.normal("next_noise", (b * *self.config.candidates as usize, a))?;
        let times = random.tensor("times", (b, 1), |generator| generator.random::<f32>())?;
        let targets = self.targets(batch, &next_noise)?;
        let critic_loss = batch.critic_loss(&self.critic, &targets)?;
        let bc_loss = flow_loss(&self.flow, batch, &start, &times)?;
        Ok([critic_loss, Loss::new("bc_loss", bc_loss)])
    }

    /// y = r + γ·mask·Q̂(s', a'), `[B]`, with the best a' by Q of those from this noise, `[B·N, a]`.
    fn targets(&self, batch: &Batch, noise: &Tensor) -> Result<Tensor> {
        let flow = FlowActor::new(self.flow.detach(), *self.config.flow_steps);
        let drawn = flow.sample(&batch.next_observations, noise)?;
        let target = self.config.target;
        let q = reduced(&batch.next_values(&self.critic.detach(), &drawn)?, target)?;
        let (n, b) = (*self.config.candidates, batch.rewards.dim(0)? as u32);
        let best = q.reshape((b as usize, n as usize))?.argmax(1)?;
        let firsts = Tensor::arange_step(0, b * n, n, noise.device())?;
        let best = drawn.index_select(&(best + firsts)?, 0)?;
        let next = reduced(&batch.next_values(&self.critic.target, &best)?, target)?;
        batch.target(*self.config.gamma, &next)
    }
}

impl Algorithm for Qc {
    /// Both losses are those of the networks before the update, and so are the critics that the
    /// targets follow.
    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let adam = AdamStep::after(step, *self.config.learning_rate);
        let losses = self.losses(step, batch)?;
        let [critic_loss, bc_loss] = &losses;
        self.critic.soft_update(*self.config.ema_rate)?;
        self.critic.minimize(&critic_loss.value, adam)?;
        self.flow.minimize(&bc_loss.value, adam)?;
        measured(&losses)
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        measured(&self.losses(step, batch)?)
    }

    /// The flow, which chooses by the critics themselves.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let choice = Choice::new(*self.config.candidates, self.config.target, Rule::Best);
        let (flow, critics) = (&self.flow, &self.critic);
        let (shape, tensors) = ActorCriticShape::from_networks(flow, critics)?;
        Ok((PolicyConfig::Flow { shape, flow_steps: *self.config.flow_steps, choice }, tensors))
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks()
    }
}
