//! A task that this program simulates: it cannot fail, and its state can be set and read.
//!
//! Gymnasium does not handle two cases, which here end the episode without reward for that step: a
//! simulation that diverges, and an action that is not a number (which is not applied). So every
//! return is finite.

use std::sync::Arc;

use mujoco_rs::wrappers::mj_model::MjModel;
use quad_dataset::{Drive, EnvironmentSpec, Noise};

use super::environment::{Environment, EnvironmentError, Step};
use super::physics::Physics;

/// The rules of a task.
pub(super) trait Task: Send + Sync {
    /// Returns the reward of the step just taken, which began with the first two positions at
    /// `from`, and whether it terminated the episode.
    fn judge(&self, from: [f64; 2], physics: &Physics) -> (f64, bool);

    /// Draws the goal of an episode.
    fn begin(&mut self, _seed: u64) {}

    /// Draws the first two positions of an episode; `None` for the model's.
    fn start(&self, _seed: u64) -> Option<[f64; 2]> {
        None
    }

    fn set_goal(&mut self, _goal: &[f64]) {}

    fn goal(&self) -> Option<&[f64]> {
        None
    }
}

/// A robot in its simulation. It observes positions, then velocities.
pub(super) struct RobotSpec {
    /// Steps of the model that a control is held for.
    pub frame_skip: usize,
    pub drive: Drive,
    /// Noise on the initial state.
    pub noise: Noise,
    /// Number of first positions that are not observed.
    pub hidden_positions: usize,
    /// Limit of each observed velocity.
    pub observed_velocity: f64,
}

/// One simulated task, with the semantics of D4RL's files.
///
/// Positions `qpos`, velocities `qvel` and observations are MuJoCo's own `f64`; a rollout rounds
/// them to `f32` for the policy.
pub struct Simulation {
    physics: Physics,
    robot: RobotSpec,
    task: Box<dyn Task>,
    observation: Vec<f64>,
    steps: usize,
    spec: &'static EnvironmentSpec,
}

impl Simulation {
    /// The first [`reset`](Self::reset) starts it.
    pub(super) fn new(
        model: Arc<MjModel>,
        robot: RobotSpec,
        task: Box<dyn Task>,
        spec: &'static EnvironmentSpec,
    ) -> Result<Self, EnvironmentError> {
        let physics = Physics::new(model, robot.frame_skip, robot.drive)?;
        let observation = vec![0.0; spec.observation_dim];
        Ok(Self { physics, robot, task, observation, steps: 0, spec })
    }

    pub fn spec(&self) -> &'static EnvironmentSpec {
        self.spec
    }

    /// Starts an episode, which is a function of its seed and its actions only.
    pub fn reset(&mut self, seed: u64) {
        self.task.begin(seed);
        let start = self.task.start(seed);
        self.physics.reset(seed, self.robot.noise, start);
        self.start();
    }

    /// Starts an episode in a given state (`nq` positions, `nv` velocities).
    pub fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.physics.set_state(qpos, qvel);
        self.start();
    }

    /// Moves the goal (x and y, meters) until it is drawn again.
    pub fn set_goal(&mut self, goal: &[f64]) {
        self.task.set_goal(goal);
    }

    /// The goal's x and y, meters, in a task that has one.
    pub fn goal(&self) -> Option<&[f64]> {
        self.task.goal()
    }

    /// Applies `action` [action_dim], clipped to ±1, for one control period.
    pub fn step(&mut self, action: &[f32]) -> Step {
        self.steps += 1;
        let truncated = self.steps >= self.spec.max_episode_steps;
        let from = [self.qpos()[0], self.qpos()[1]];
        let is_valid = self.physics.step(action);
        self.observe();
        let (reward, terminated) = match is_valid {
            true => self.task.judge(from, &self.physics),
            false => (0.0, true),
        };
        let is_beyond = action.iter().any(|value| value.abs() > 1.0);
        let clip = || action.iter().map(|value| value.clamp(-1.0, 1.0)).collect();
        let clipped = is_beyond.then(clip);
        Step { reward, terminated, truncated, clipped, ..Step::default() }
    }

    /// Simulated time of a step, seconds.
    pub fn control_period(&self) -> f64 {
        self.physics.dt()
    }

    /// [observation_dim]
    pub fn observation(&self) -> &[f64] {
        &self.observation
    }

    pub fn qpos(&self) -> &[f64] {
        self.physics.qpos()
    }

    pub fn qvel(&self) -> &[f64] {
        self.physics.qvel()
    }

    fn start(&mut self) {
        self.steps = 0;
        self.observe();
    }

    fn observe(&mut self) {
        let limit = self.robot.observed_velocity;
        let visible = &self.physics.qpos()[self.robot.hidden_positions..];
        let (positions, velocities) = self.observation.split_at_mut(visible.len());
        positions.copy_from_slice(visible);
        for (observed, velocity) in velocities.iter_mut().zip(self.physics.qvel()) {
            *observed = velocity.clamp(-limit, limit);
        }
    }
}

/// With D4RL's normalized score.
impl Environment for Simulation {
    fn name(&self) -> &str {
        &self.spec.name
    }

    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        self.reset(seed);
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        Ok(self.step(action))
    }

    fn observation(&self) -> &[f64] {
        self.observation()
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        Ok(self.spec.normalized_score(episode_return))
    }
}
