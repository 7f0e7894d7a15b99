//! Mixes episodes of a search's policies, from the first to the last, into one dataset.

use quad_dataset::{D4rlWriter, DatasetError, EnvironmentSpec, Recipe, RecordedStep};
use quad_runtime::{Hint, ProgressBar};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::search::LinearPolicy;
use super::{MUJOCO, OUT, stream};
use crate::sim::{self, EnvironmentError, Simulation, Step};

/// Range of the standard deviation of an episode's Gaussian action noise (actions span ±1): enough
/// to show the effects of other actions in a state, up to more than most gaits survive.
const NOISE: std::ops::Range<f64> = 0.1..0.5;

/// Episodes that run in parallel.
const ROUND: usize = 32;

/// After simulating this many times the wanted transitions, the recorder takes any episode: a
/// search that never got good has none for the upper bands.
const PATIENCE: usize = 4;

/// Stream of an episode's seed for the noise of actions.
const NOISE_STREAM: u64 = 3;

/// Records whole episodes, each of a policy drawn from `policies`, until there are `transitions`
/// rows. Returns each episode's normalized score.
pub fn record(
    spec: &'static EnvironmentSpec,
    recipe: &Recipe,
    policies: &[LinearPolicy],
    transitions: usize,
    mut random: ChaCha8Rng,
    writer: &mut D4rlWriter,
) -> anyhow::Result<Vec<f64>> {
    let recorders = (0..ROUND).map(|_| Recorder::new(spec));
    let mut recorders = recorders.collect::<Result<Vec<_>, _>>().hint(MUJOCO)?;
    let mixture = &recipe.mixture;
    let mut room: Vec<f64> = mixture.iter().map(|(_, share)| share * transitions as f64).collect();
    let mut scores = Vec::new();
    let mut simulated = 0;
    let progress = ProgressBar::new("transitions recorded");
    progress.start(0, transitions as u64);
    loop {
        // An episode beyond the end of the highest unfilled band is useless.
        let patient = simulated <= PATIENCE * transitions;
        let highest = room.iter().rposition(|&room| room > 0.0).filter(|_| patient);
        let next = highest.and_then(|band| mixture.get(band + 1));
        let ceiling = next.map_or(f64::INFINITY, |&(from, _)| from);
        let mut draw = |_| {
            let policy = &policies[random.random_range(0..policies.len())];
            (policy, random.random())
        };
        let drawn: Vec<(&LinearPolicy, u64)> = (0..ROUND).map(&mut draw).collect();
        let running = recorders.par_iter_mut().zip(drawn).with_max_len(1);
        running.for_each(|(recorder, (policy, seed))| recorder.run(policy, seed, ceiling));
        for recorder in &recorders {
            simulated += recorder.steps.len();
            let score = spec.normalized_score(recorder.episode_return);
            let band = mixture.iter().rposition(|&(from, _)| score >= from).unwrap_or(0);
            if recorder.ended() && (room[band] > 0.0 || !patient) {
                room[band] -= recorder.steps.len() as f64;
                recorder.write(writer).hint(OUT)?;
                scores.push(score);
            }
            if writer.rows() >= transitions {
                return Ok(scores);
            }
        }
        progress.advance(writer.rows() as u64);
    }
}

/// An environment and its last episode.
struct Recorder {
    environment: Simulation,
    /// The initial state, then one after each step.
    states: Vec<[Vec<f64>; 3]>,
    /// Clipped actions [action_dim], and what follows.
    steps: Vec<(Vec<f64>, Step)>,
    episode_return: f64,
}

impl Recorder {
    fn new(spec: &'static EnvironmentSpec) -> Result<Self, EnvironmentError> {
        let environment = sim::make(spec, 0)?;
        Ok(Self { environment, states: Vec::new(), steps: Vec::new(), episode_return: 0.0 })
    }

    /// Runs an episode to its end, or until its score so far is above `ceiling`.
    fn run(&mut self, policy: &LinearPolicy, seed: u64, ceiling: f64) {
        self.states.clear();
        self.steps.clear();
        self.episode_return = 0.0;
        let spec = self.environment.spec();
        let mut random = stream(seed, NOISE_STREAM);
        let deviation = random.random_range(NOISE);
        let mut action = vec![0.0; spec.action_dim];
        self.environment.reset(seed);
        self.keep_state();
        loop {
            policy.act(self.environment.observation(), &mut action);
            for value in &mut action {
                let noise: f64 = StandardNormal.sample(&mut random);
                *value = (f64::from(*value) + deviation * noise).clamp(-1.0, 1.0) as f32;
            }
            let step = self.environment.step(&action);
            self.episode_return += step.reward;
            self.steps.push((action.iter().copied().map(f64::from).collect(), step));
            self.keep_state();
            if self.ended() || spec.normalized_score(self.episode_return) > ceiling {
                return;
            }
        }
    }

    fn ended(&self) -> bool {
        let last = self.steps.last();
        last.is_some_and(|(_, step)| step.terminated || step.truncated)
    }

    fn keep_state(&mut self) {
        let simulation = &self.environment;
        let state = [simulation.observation(), simulation.qpos(), simulation.qvel()];
        self.states.push(state.map(<[f64]>::to_vec));
    }

    fn write(&self, writer: &mut D4rlWriter) -> Result<(), DatasetError> {
        for ((action, step), states) in self.steps.iter().zip(self.states.windows(2)) {
            let [observation, qpos, qvel] = &states[0];
            writer.push(&RecordedStep {
                observation,
                action,
                next_observation: &states[1][0],
                reward: step.reward,
                terminal: step.terminated,
                timeout: step.truncated && !step.terminated,
                qpos,
                qvel,
            })?;
        }
        Ok(())
    }
}
