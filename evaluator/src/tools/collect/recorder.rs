//! A simulation that keeps its last episode, as a dataset has it.

use quad_dataset::{D4rlWriter, DatasetError, EnvironmentSpec, RecordedStep};

use crate::sim::{self, Environment, EnvironmentError, Simulation, Step};

/// An environment and its last episode.
pub struct Recorder {
    environment: Simulation,
    /// The initial state, then one after each step.
    states: Vec<[Vec<f64>; 3]>,
    /// Clipped actions [action_dim], and what follows.
    steps: Vec<(Vec<f64>, Step)>,
    pub episode_return: f64,
}

impl Recorder {
    pub fn new(spec: &'static EnvironmentSpec) -> Result<Self, EnvironmentError> {
        let environment = sim::make(spec, 0)?;
        Ok(Self { environment, states: Vec::new(), steps: Vec::new(), episode_return: 0.0 })
    }

    pub fn spec(&self) -> &'static EnvironmentSpec {
        self.environment.spec()
    }

    /// Steps of the episode.
    pub fn length(&self) -> usize {
        self.steps.len()
    }

    pub fn begin(&mut self, seed: u64) {
        self.states.clear();
        self.steps.clear();
        self.episode_return = 0.0;
        self.environment.reset(seed);
        self.keep_state();
    }

    pub fn advance(&mut self, action: &[f32]) -> Step {
        let step = self.environment.step(action);
        self.episode_return += step.reward;
        let taken = step.clipped.as_deref().unwrap_or(action);
        self.steps.push((taken.iter().copied().map(f64::from).collect(), step.clone()));
        self.keep_state();
        step
    }

    pub fn ended(&self) -> bool {
        let last = self.steps.last();
        last.is_some_and(|(_, step)| step.terminated || step.truncated)
    }

    fn keep_state(&mut self) {
        let simulation = &self.environment;
        let state = [simulation.observation(), simulation.qpos(), simulation.qvel()];
        self.states.push(state.map(<[f64]>::to_vec));
    }

    pub fn write(&self, writer: &mut D4rlWriter) -> Result<(), DatasetError> {
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

impl Environment for Recorder {
    fn name(&self) -> &str {
        &self.spec().name
    }

    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        self.begin(seed);
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        Ok(self.advance(action))
    }

    fn observation(&self) -> &[f64] {
        self.environment.observation()
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        self.environment.score(episode_return)
    }
}
