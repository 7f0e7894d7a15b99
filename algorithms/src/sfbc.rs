//! SfBC (Chen, Lu, Ying, Su and Zhu 2022, "Offline Reinforcement Learning via High-Fidelity
//! Generative Behavior Modeling"): a score network clones the data's policy; a critic learns
//! returns; then returns are planned anew with what the critic says of the clone's actions, and
//! another critic learns these. The policy takes the best of the clone's samples.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/sfbc.rs"]
mod golden;

use super::algorithm::{AgentError, Algorithm, AlgorithmError, Loss, Measured, check, measured};
use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric, Reporting, metrics, read};
use super::denoising::{NoiseInTime, normal};
use super::hyperparameters::{Candidates, Count, Positive, Steps, UnitInterval};
use super::parts::Parts;
use super::phases;
use super::random::{Purpose, stream};
use super::returns::Returns;
use super::train_state::{TrainState, ensemble, initial};
use candle_core::{Device, Result, Tensor};
use quad_dataset::Batch;
use quad_nn::{AdamStep, DpmSolver, Ensemble, MlpConfig, ScoreNetwork, ScoreShape, Tensors};
use quad_policy::{Aggregate, Choice, PolicyConfig, Rule, ScorePolicy, ScorePolicyShape};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::Deserialize;
use std::ops::Range;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "sfbc",
    settings: include_str!("../../presets/sfbc.toml"),
    metrics: METRICS,
    report: Reporting { counts: &["candidates"], ..Reporting::PLAIN },
    check: |table| Config::of(table).map(drop),
    start: |table, context| Ok(Box::new(Sfbc::new(Config::of(table)?, context)?)),
};

/// The earliest time whose noise is learned.
const FIRST_TIME: f64 = 1e-5;
/// States whose actions are drawn together.
const TOGETHER: usize = 256;

const METRICS: &[Metric] = &metrics! {
    bc_loss ["BC loss"]: "First phase: mean over the batch of the sum over dimensions of (ε − ε_θ(a_t, s, t))². A network that always outputs 0 has the number of dimensions as its loss.";
    critic_loss ["critic loss"]: "A critic's round: mean over the batch of (Q(s, a) − target)², of standardized returns.";
    q_mean: "A critic's round: mean over the batch of the targets, standardized returns.";
    v_mean ["V"]: "Planning: mean over the step's states of V(s) = Σ softmax(Q/planning_temperature)·Q over actions of the clone, in units of the return.";
};

/// SfBC's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// The score network's narrowing blocks.
    actor: MlpConfig,
    critic: MlpConfig,
    /// Discount γ.
    gamma: UnitInterval,
    /// Evaluations of the score network for an action.
    evaluations: Count,
    /// Actions of the clone, of whose values V is made, and the temperature of its softmax.
    samples: Count,
    planning_temperature: Positive,
    /// What the policy draws, how many of these it averages, and the temperature by which it draws
    /// them.
    candidates: Candidates,
    averaged: Candidates,
    temperature: Positive,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    /// Episodes of fewer transitions are left out.
    shortest_episode: Count,
    phases: Phases,
}

impl Config {
    fn of(table: &toml::Table) -> std::result::Result<Self, AgentError> {
        let config: Self = read(table)?;
        let Self { averaged, candidates, .. } = config;
        check("averaged", *averaged, *averaged <= *candidates, "at most candidates")?;
        check(
            "actor.norm",
            config.actor.norm,
            !config.actor.norm,
            "false: this network has no norm",
        )?;
        Ok(config)
    }
}

/// The phases' lengths in proportion: cloning, a round of each of two critics (K = 2), and between
/// these planning.
#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct Phases {
    behavior: Steps,
    critic: Steps,
    planning: Steps,
}

/// What an update does.
enum Phase {
    Behavior,
    /// The round's number, from 0.
    Critic(usize),
    /// Values of these items' states, of all items in turn.
    Planning(Range<usize>),
}

/// SfBC in the middle of a run.
struct Sfbc {
    config: Config,
    context: Context,
    shape: ScorePolicyShape,
    solver: DpmSolver,
    /// The transitions to learn from, episode by episode, and their returns.
    items: Vec<u32>,
    returns: Returns,
    /// ε_θ.
    actor: TrainState<ScoreNetwork>,
    critic: TrainState<Ensemble>,
}

impl Sfbc {
    fn new(config: Config, context: Context) -> std::result::Result<Self, AlgorithmError> {
        let mut all = context.transitions.episodes();
        all.retain(|episode| episode.len() >= *config.shortest_episode);
        let mut end = 0;
        let place = |episode: &Range<u32>| {
            let start = end;
            end += episode.len();
            start..end
        };
        let episodes = all.iter().map(place).collect();
        let items: Vec<u32> = all.into_iter().flatten().collect();
        if items.is_empty() {
            return Err(AlgorithmError::ShortEpisodes(*config.shortest_episode));
        }
        let mut rows = Batch::default();
        context.transitions.gather(&items, &mut rows);
        let shape = ScorePolicyShape {
            observation_dim: context.observation_dim(),
            action_dim: context.action_dim(),
            actor: config.actor.clone(),
            critic: config.critic.clone(),
            evaluations: *config.evaluations,
        };
        let frequencies = ScoreShape::frequencies(&mut stream(context.seed, Purpose::Weights, 2))?;
        let weights = initial(&shape.actor().layout(), &context, 0)?;
        Ok(Self {
            actor: TrainState::new(ScoreNetwork::new(shape.actor(), weights, frequencies), 0.0)?,
            critic: first_critic(&shape, &context)?,
            solver: DpmSolver::new(shape.evaluations),
            returns: Returns::new(rows.rewards, episodes, *config.gamma)?,
            items,
            shape,
            config,
            context,
        })
    }

    /// The steps at which cloning, the first critic's round, planning and the second critic's round
    /// begin.
    fn begins(&self) -> [u64; 4] {
        let Phases { behavior, critic, planning } = self.config.phases;
        phases::begin(self.context.total_steps, [behavior, critic, planning, critic])
    }

    /// What update number `step` does, and how many came before it in its phase.
    fn phase(&self, step: u64) -> (Phase, u64) {
        let begins = self.begins();
        let number = begins.partition_point(|begin| *begin <= step) - 1;
        let steps = step - begins[number];
        let phase = match number {
            0 => Phase::Behavior,
            1 => Phase::Critic(0),
            3 => Phase::Critic(1),
            _ => {
                let before = |steps: u64| {
                    let length = u128::from(begins[number + 1] - begins[number]);
                    (u128::from(steps) * self.items.len() as u128 / length) as usize
                };
                Phase::Planning(before(steps)..before(steps + 1))
            }
        };
        (phase, steps)
    }

    /// ε_θ toward the noise in the data's actions.
    fn clone_behavior(
        &mut self,
        batch: &Minibatch,
        noise: &NoiseInTime,
        steps: u64,
    ) -> Result<Measured> {
        let noisy = noise.noisy(&batch.actions)?;
        let predicted = self.actor.network.predict(&batch.observations, &noisy, &noise.t)?;
        let loss = (predicted - &noise.epsilon)?.sqr()?.sum(1)?.mean_all()?;
        self.actor.minimize(&loss, AdamStep::after(steps, *self.config.actor_learning_rate))?;
        measured(&[Loss::new("bc_loss", loss)])
    }

    /// Q(s, a) toward the returns of these items, the batch. Each round has a critic of its own,
    /// which begins as the first did.
    fn learn_returns(
        &mut self,
        batch: &Minibatch,
        items: &[u32],
        round: usize,
        steps: u64,
    ) -> Result<Measured> {
        if round > 0 && steps == 0 {
            self.critic = first_critic(&self.shape, &self.context)?;
        }
        let items = Tensor::from_slice(items, items.len(), &Device::Cpu)?;
        let targets =
            self.returns.targets.index_select(&items, 0)?.to_device(&self.context.device)?;
        let loss =
            self.critic.network.squared_error(&batch.observations, &batch.actions, &targets)?;
        self.critic.minimize(&loss, AdamStep::after(steps, *self.config.critic_learning_rate))?;
        measured(&[Loss::new("critic_loss", loss).with("q_mean", targets.mean_all()?)])
    }

    /// Keeps V(s) = Σ softmax(Q/temperature)·Q over S actions of the clone, in units of the return,
    /// for the states of some items. The actions are drawn with this noise, `[items · S, a]`.
    fn value(&mut self, items: Range<usize>, noise: &Tensor) -> Result<()> {
        let (first, count) = (items.start, items.len());
        let observations = self.context.batch(&self.items[items])?.observations;
        let actions = self.actor.network.sample(&self.solver, &observations, noise)?;
        let q =
            self.critic.network.detach().values(&observations, &actions)?.reshape((count, ()))?;
        let exponents = q.broadcast_sub(&q.max_keepdim(1)?)?;
        let weights = (exponents / f64::from(*self.config.planning_temperature))?.exp()?;
        let values = ((&weights * q)?.sum(1)? / weights.sum(1)?)?;
        self.returns.keep(&self.returns.unscaled(&values)?, first)
    }

    /// After [`Self::value`] of these items: with the last of all, makes new returns.
    fn plan(&mut self, items: Range<usize>) -> Result<Measured> {
        if items.end == self.items.len() {
            self.returns.plan()?;
        }
        Ok(self.returns.mean_value(items)?.map(|mean| ("v_mean", mean)).into_iter().collect())
    }

    /// The noise of a cloning step.
    fn noise(&self, step: u64) -> Result<NoiseInTime> {
        let (context, generator) =
            (&self.context, &mut stream(self.context.seed, Purpose::Noise, step));
        let epsilon =
            normal((context.batch_size, context.action_dim()), generator, &context.device)?;
        let t = (0..context.batch_size).map(|_| generator.random_range(FIRST_TIME..1.0)).collect();
        Ok(NoiseInTime { t, epsilon })
    }

    /// The noise of the clone's actions in some states.
    fn noise_of(&self, rows: &[u32]) -> Result<Tensor> {
        let (count, a) = (*self.config.samples, self.context.action_dim());
        let numbers = rows.iter().flat_map(|row| {
            let mut generator = stream(self.context.seed, Purpose::Actions, u64::from(*row));
            (0..count * a).map(move |_| StandardNormal.sample(&mut generator))
        });
        Tensor::from_vec(
            numbers.collect::<Vec<f32>>(),
            (rows.len() * count, a),
            &self.context.device,
        )
    }
}

/// A critic at its beginning.
fn first_critic(shape: &ScorePolicyShape, context: &Context) -> Result<TrainState<Ensemble>> {
    ensemble(shape.critic(), context, 1)
}

impl Algorithm for Sfbc {
    fn items(&self, _: usize) -> usize {
        self.items.len()
    }

    fn phases(&self) -> Vec<u64> {
        self.begins().to_vec()
    }

    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let (phase, steps) = self.phase(step);
        let rows: Vec<u32> = items.iter().map(|item| self.items[*item as usize]).collect();
        match phase {
            Phase::Behavior => {
                self.clone_behavior(&self.context.batch(&rows)?, &self.noise(step)?, steps)
            }
            Phase::Critic(round) => {
                self.learn_returns(&self.context.batch(&rows)?, items, round, steps)
            }
            Phase::Planning(items) => {
                for some in items
                    .clone()
                    .step_by(TOGETHER)
                    .map(|first| first..(first + TOGETHER).min(items.end))
                {
                    let noise = self.noise_of(&self.items[some.clone()])?;
                    self.value(some, &noise)?;
                }
                self.plan(items)
            }
        }
    }

    /// Nothing: its state has a return of each transition that it learns from, and of no other.
    fn evaluate(&self, _: u64, _: &[u32]) -> Result<Measured> {
        Ok(Measured::new())
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let rule =
            Rule::Average { temperature: *self.config.temperature, actions: *self.config.averaged };
        let choice = Choice { candidates: *self.config.candidates, value: Aggregate::Mean, rule };
        let tensors = ScorePolicy::tensors(&self.actor.network, &self.critic.network)?;
        Ok((PolicyConfig::Score { shape: self.shape.clone(), choice }, tensors))
    }

    fn parts(&mut self) -> Parts<'_> {
        // The frequencies do not change: they are a function of the seed.
        let parts =
            Parts::default().trained("actor", &mut self.actor).trained("critic", &mut self.critic);
        self.returns.parts(parts)
    }
}
