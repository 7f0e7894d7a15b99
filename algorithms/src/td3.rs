//! TD3 (Fujimoto, van Hoof and Meger 2018) with a policy that stays near the data's actions:
//! TD3+BC and ReBRAC. Critics move in every step, the policy and the targets in every
//! `actor_every`-th. An algorithm of this kind is a [`BcRegularizer`].

use super::gaussian::gaussian_policy;
use super::losses::joined;
use super::prelude::*;
use super::state_dict::write;
use quad_policy::{Spread, gaussian_mean};

#[derive(Clone, Deserialize)]
pub(super) struct Common {
    actor: MlpConfig,
    critic: MlpConfig,
    gamma: UnitInterval,
    /// Standard deviation of the noise in the targets' actions, and its largest size.
    target_noise: NotNegative,
    target_noise_limit: NotNegative,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    ema_rate: Rate,
    /// Steps of the critics for each step of policy and targets.
    actor_every: Steps,
    /// Smallest factor of the policy's distance to the data: online it is 1 less the share
    /// that is over, but no less than this.
    online_cloning: UnitInterval,
}

/// The hyper-parameters of an algorithm, and its way to keep the policy near the data's actions.
pub(super) trait BcRegularizer: Send {
    /// The first step in which the policy moves.
    const FIRST: u64;
    /// The target policy follows the policy from before its step.
    const LAGS: bool;

    fn common(&self) -> &Common;

    /// Weight of the squared distance between next actions and the data's in the critics' target,
    /// if there is such a term; online there is none.
    fn penalty(&self) -> Option<f32> {
        None
    }

    /// The loss `[]` of the policy's actions, `[B, a]`, whose values are `q`, `[2, B]`; and the
    /// part of it that keeps them near the data's, before it is multiplied by `cloning`.
    fn actor_loss(
        &self,
        actions: &Tensor,
        data: &Tensor,
        q: &Tensor,
        cloning: f64,
    ) -> Result<[Tensor; 2]>;
}

networks! {
    pub(super) struct Networks(config: &Common, init) {
        /// Network whose tanh is the policy π.
        actor: WithTarget<Ensemble> = init
            .state_network(&config.actor, init.context.action_dim())?
            .with_target(Ensemble::copy),
        critic: WithTarget<Ensemble> = init.critics(TWIN, &config.critic),
    }
}

pub(super) struct Td3<R> {
    regularizer: R,
    context: Context,
    networks: Networks,
    /// The policy's last `actor_loss` and `bc_loss`, `[2]`.
    actor_losses: Tensor,
}

impl<R: BcRegularizer> Td3<R> {
    pub fn new(regularizer: R, context: Context) -> Result<Self> {
        let networks = Networks::new(regularizer.common(), &mut Initializer::new(&context))?;
        let actor_losses = Tensor::zeros(2, DType::F32, &context.device)?;
        Ok(Self { regularizer, context, networks, actor_losses })
    }

    fn critic_loss(&self, step: u64, batch: &Batch) -> Result<Loss> {
        let targets = self.targets(step, batch)?;
        let loss = batch.squared_error(&self.networks.critic, &targets)?;
        Loss::critics((loss * TWIN as f64)?, &targets)
    }

    /// y = r + γ·mask·(min_k Q̂_k(s', ã') − penalty·Σ (ã' − a')²), `[B]`, with the data's next
    /// action a'.
    fn targets(&self, step: u64, batch: &Batch) -> Result<Tensor> {
        let common = self.regularizer.common();
        let mut random = self.context.random(step);
        let noise = random.normal("target_noise", batch.actions.shape())?;
        let limit = f64::from(*common.target_noise_limit);
        let noise = (noise * f64::from(*common.target_noise))?.clamp(-limit, limit)?;
        let mean = gaussian_mean(&self.networks.actor.target, &batch.next_observations)?;
        let actions = (mean + noise)?.clamp(-1.0, 1.0)?;
        let mut q = smallest(&batch.next_values(&self.networks.critic.target, &actions)?)?;
        if let (Some(penalty), Some(next)) = (self.regularizer.penalty(), &batch.next_actions) {
            q = (q - ((actions - next)?.sqr()?.sum(1)? * f64::from(penalty))?)?;
        }
        batch.target(*common.gamma, &q)
    }

    fn actor_loss(&self, step: u64, batch: &Batch) -> Result<[Tensor; 2]> {
        let actions = gaussian_mean(&self.networks.actor, &batch.observations)?;
        let q = batch.values_at(&self.networks.critic.detach(), &actions)?;
        let least = f64::from(*self.regularizer.common().online_cloning);
        let share = self.context.online_share(step).unwrap_or(0.0);
        let cloning = least.max(1.0 - share);
        self.regularizer.actor_loss(&actions, &batch.actions, &q, cloning)
    }
}

impl<R: BcRegularizer> Algorithm for Td3<R> {
    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let mut losses = vec![self.critic_loss(step, batch)?];
        let common = self.regularizer.common();
        let every = *common.actor_every;
        let adam = AdamStep::after(step, *common.critic_learning_rate);
        self.networks.critic.minimize(&losses[0].value, adam)?;
        let first = R::FIRST % every;
        if step % every == first {
            let [actor_loss, bc_loss] = self.actor_loss(step, batch)?;
            let Networks { actor, critic } = &mut self.networks;
            if R::LAGS {
                actor.soft_update(*common.ema_rate)?;
            }
            let adam = AdamStep::after(step / every, *common.actor_learning_rate);
            actor.minimize(&actor_loss, adam)?;
            if !R::LAGS {
                actor.soft_update(*common.ema_rate)?;
            }
            critic.soft_update(*common.ema_rate)?;
            let losses = joined([&actor_loss, &bc_loss])?;
            write(&self.actor_losses, &losses.detach())?;
        }
        if step >= first {
            let [actor_loss, bc_loss] = [self.actor_losses.get(0)?, self.actor_losses.get(1)?];
            losses.push(Loss::new("actor_loss", actor_loss).with("bc_loss", bc_loss));
        }
        measured(&losses)
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        let [actor_loss, bc_loss] = self.actor_loss(step, batch)?;
        let actor_loss = Loss::new("actor_loss", actor_loss).with("bc_loss", bc_loss);
        measured(&[self.critic_loss(step, batch)?, actor_loss])
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        gaussian_policy(&self.networks.actor, Spread::None, None)
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks.state_dict().with("of_actor", &mut self.actor_losses)
    }
}
