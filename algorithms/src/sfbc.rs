//! SfBC (Chen, Lu, Ying, Su and Zhu 2022, "Offline Reinforcement Learning via High-Fidelity
//! Generative Behavior Modeling"): a score network clones the data's policy; a critic learns
//! returns; then returns are planned anew with what the critic says of the clone's actions, and
//! another critic learns these. The policy takes the best of the clone's samples.

use super::examples::{Examples, episode_rewards};
use super::prelude::*;
use super::random::{Purpose, stream};
use super::returns::Returns;
use quad_dataset::Window;
use quad_nn::{ContinuousNoise, DpmSolver, ScoreNetwork, ScoreShape};
use quad_policy::{ScorePolicy, ScorePolicyShape};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use std::ops::Range;

pub(super) const DEFINITION: Definition = Definition {
    name: "sfbc",
    presets: include_str!("../../presets/sfbc.toml"),
    metrics: METRICS,
    read: |table| {
        let config = Config::read(table)?;
        let columns = Columns::Episodes(*config.shortest_episode);
        Ok(Start { columns, ..start(config, Sfbc::new) })
    },
    ..Definition::PLAIN
};

/// The earliest time whose noise is learned.
const FIRST_TIME: f64 = 1e-5;
/// States whose actions are drawn together.
const TOGETHER: usize = 256;

const METRICS: &[Metric] = &metrics! {
    bc_loss ["BC loss"]: "First phase: mean over the batch of the sum over dimensions of (ε − ε_θ(a_t, s, t))². A network that always outputs 0 has the number of dimensions as its loss.";
    critic_loss ["critic loss"]: "A critic's round: mean over the batch of (Q(s, a) − target)², of standardized returns.";
    target_q_mean: "A critic's round: mean over the batch of the targets, standardized returns.";
    v_mean ["V"]: "Planning: mean over the step's states of V(s) = Σ softmax(Q/planning_temperature)·Q over actions of the clone, in units of the return.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// The score network's narrowing blocks.
    actor: MlpConfig,
    critic: MlpConfig,
    gamma: UnitInterval,
    /// Evaluations of the score network for an action.
    evaluations: Count,
    /// Actions of the clone whose values make V, and the temperature of its softmax.
    samples: Count,
    planning_temperature: Positive,
    /// Actions that the policy draws, number of those it averages, and the temperature by which
    /// these are chosen.
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
    fn read(table: &toml::Table) -> std::result::Result<Self, AgentError> {
        let config: Self = read(table)?;
        let (averaged, norm) = (*config.averaged, config.actor.norm);
        let fits = averaged <= *config.candidates;
        check("averaged", averaged, fits, "at most agent.candidates")?;
        check("actor.norm", norm, !norm, "false: this network has no norm")?;
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

networks! {
    struct Networks(config: &Config, init) {
        /// ε_θ.
        actor: TrainState<ScoreNetwork> = {
            let shape = ScoreShape {
                observation_dim: init.context.observation_dim(),
                action_dim: init.context.action_dim(),
                layers: config.actor.clone(),
            };
            // From the stream after the networks' own: as a function of the seed, they are no state.
            let mut random = init.context.random_for(Purpose::Weights, 2);
            let draw = |generator: &mut _| ScoreShape::frequencies(generator)?.to_vec1::<f32>();
            let frequencies = random.vector("frequencies", draw)?;
            let frequencies = Tensor::new(frequencies, &Device::Cpu)?;
            let precision = init.context.precision;
            let network = |weights| ScoreNetwork::new(shape.clone(), weights, frequencies, precision);
            init.network(&shape.layout(), network)
        },
        critic: TrainState<Ensemble> = init.ensemble(init.shape(&config.critic)),
    }
}

struct Sfbc {
    config: Config,
    context: Context,
    /// The transitions to learn from, episode by episode, and their returns.
    examples: Examples,
    returns: Returns,
    networks: Networks,
}

impl Sfbc {
    fn new(config: Config, context: Context) -> std::result::Result<Self, AlgorithmError> {
        let shortest = *config.shortest_episode;
        let (transitions, columns) = (context.transitions.clone(), Columns::Episodes(shortest));
        let examples = Examples::new(transitions, columns, Window::ONE)?;
        let (mut rewards, mut episodes) = (Vec::new(), Vec::new());
        for episode in context.transitions.episodes() {
            if episode.len() >= shortest {
                let first = rewards.len();
                rewards.extend(episode_rewards(&context.transitions, episode).0);
                episodes.push(first..rewards.len());
            }
        }
        let returns = Returns::new(rewards, episodes, *config.gamma)?;
        let networks = Networks::new(&config, &mut Initializer::new(&context))?;
        Ok(Self { config, context, examples, returns, networks })
    }

    /// The first steps of cloning, the first critic's round, planning and the second critic's.
    fn first_steps(&self) -> [u64; 4] {
        let phases = self.config.phases;
        let lengths = [phases.behavior, phases.critic, phases.planning, phases.critic];
        first_steps(self.context.total_steps, lengths)
    }

    /// ε_θ toward the noise in the data's actions.
    fn clone_behavior(&mut self, step: u64, batch: &Batch, adam: AdamStep) -> Result<Measured> {
        let (mut random, rows) = (self.context.random(step), batch.size());
        let epsilon = random.normal("epsilon", batch.actions.shape())?;
        let t: Vec<f64> = random.vector("t", |generator| {
            Ok((0..rows).map(|_| generator.random_range(FIRST_TIME..1.0)).collect())
        })?;
        let column = |factor: fn(ContinuousNoise) -> f64| {
            let numbers = t.iter().map(|t| factor(ContinuousNoise::new(*t)) as f32);
            Tensor::from_vec(numbers.collect(), (rows, 1), &self.context.device)
        };
        let signal = batch.actions.broadcast_mul(&column(|noise| noise.signal)?)?;
        let noisy = (signal + epsilon.broadcast_mul(&column(|noise| noise.deviation)?)?)?;
        let actor = &mut self.networks.actor;
        let predicted = actor.predict(&batch.observations, &noisy, &t)?;
        let loss = (predicted - epsilon)?.sqr()?.sum(1)?.mean_all()?;
        actor.minimize(&loss, adam)?;
        measured(&[Loss::new("bc_loss", loss)])
    }

    /// Q(s, a) toward the returns of the batch's transitions.
    fn learn_returns(&mut self, batch: &Batch, adam: AdamStep) -> Result<Measured> {
        let indices = Tensor::from_slice(&batch.indices, batch.size(), &Device::Cpu)?;
        let targets = self.returns.targets.index_select(&indices, 0)?;
        let targets = targets.to_device(&self.context.device)?;
        let loss = batch.critic_loss(&self.networks.critic, &targets)?;
        self.networks.critic.minimize(&loss.value, adam)?;
        measured(&[loss])
    }

    /// V(s) of the states in a range, and with the last of all states new returns.
    fn plan(&mut self, states: Range<usize>) -> Result<Measured> {
        for first in states.clone().step_by(TOGETHER) {
            self.value(first..(first + TOGETHER).min(states.end))?;
        }
        if states.end == self.examples.len() {
            self.returns.plan()?;
        }
        let mean = self.returns.mean_value(states)?;
        Ok(mean.map(|mean| ("v_mean", mean)).into_iter().collect())
    }

    /// Keeps V(s) = Σ softmax(Q/temperature)·Q over S actions of the clone, in units of the return,
    /// for the states in a range.
    fn value(&mut self, states: Range<usize>) -> Result<()> {
        let (first, Networks { actor, critic }) = (states.start, &self.networks);
        let states = Vec::from_iter(states.start as u32..states.end as u32);
        let (rows, batch) = (self.examples.rows(&states), self.examples.batch(&states)?);
        let observations = batch.observations.to_device(&self.context.device)?;
        let solver = DpmSolver::new(*self.config.evaluations);
        let actions = actor.sample(&solver, &observations, &self.noise(&rows)?)?;
        let q = critic.detach().values(&observations, &actions)?;
        let q = q.reshape((rows.len(), ()))?;
        let exponents = q.broadcast_sub(&q.max_keepdim(1)?)?;
        let weights = (exponents / f64::from(*self.config.planning_temperature))?.exp()?;
        let values = ((&weights * q)?.sum(1)? / weights.sum(1)?)?;
        self.returns.keep(&self.returns.unscaled(&values)?, first)
    }

    /// The noise of the clone's S actions in some states, `[states·S, a]`.
    fn noise(&self, rows: &[u32]) -> Result<Tensor> {
        let (count, a) = (*self.config.samples, self.context.action_dim());
        let drawn = |row: &u32| {
            let mut generator = stream(self.context.seed, Purpose::Actions, u64::from(*row));
            (0..count * a).map(move |_| -> f32 { StandardNormal.sample(&mut generator) })
        };
        let mut random = self.context.random_for(Purpose::Actions, 0);
        let numbers =
            random.vector("planning_noise", |_| Ok(rows.iter().flat_map(drawn).collect()))?;
        Tensor::from_vec(numbers, (rows.len() * count, a), &self.context.device)
    }
}

impl Algorithm for Sfbc {
    fn phases(&self) -> Vec<u64> {
        self.first_steps().to_vec()
    }

    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let first_steps = self.first_steps();
        let (phase, steps) = phase(&first_steps, step);
        if phase == 2 {
            let [rows, length] =
                [self.examples.len() as u64, first_steps[3] - first_steps[2]].map(u128::from);
            let before = |steps: u64| (u128::from(steps) * rows / length) as usize;
            return self.plan(before(steps)..before(steps + 1));
        }
        if phase == 0 {
            let adam = AdamStep::after(steps, *self.config.actor_learning_rate);
            return self.clone_behavior(step, batch, adam);
        }
        if phase == 3 && steps == 0 {
            // The second critic begins as the first did.
            let networks = Networks::new(&self.config, &mut Initializer::new(&self.context))?;
            self.networks.critic = networks.critic;
        }
        let adam = AdamStep::after(steps, *self.config.critic_learning_rate);
        self.learn_returns(batch, adam)
    }

    /// Measures nothing: only the transitions that it learns from have returns.
    fn evaluate(&self, _: u64, _: &Batch) -> Result<Measured> {
        Ok(Measured::new())
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let (temperature, actions) = (*self.config.temperature, *self.config.averaged);
        let rule = Rule::Average { temperature, actions };
        let choice = Choice::new(*self.config.candidates, Aggregate::Mean, rule);
        let shape = ScorePolicyShape {
            observation_dim: self.context.observation_dim(),
            action_dim: self.context.action_dim(),
            actor: self.config.actor.clone(),
            critic: self.config.critic.clone(),
            evaluations: *self.config.evaluations,
        };
        let Networks { actor, critic } = &self.networks;
        let tensors = ScorePolicy::tensors(actor, critic)?;
        Ok((PolicyConfig::Score { shape, choice }, tensors))
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.returns.add_to(self.networks.state_dict())
    }
}
