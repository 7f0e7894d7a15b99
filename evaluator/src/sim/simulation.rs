//! A task that this program simulates: it cannot fail, and its state can be set and read.
//!
//! Gymnasium does not handle two cases, which here end the episode without reward for that step: a
//! simulation that diverges, and an action that is not a number (which is not applied). So every
//! return is finite.

use std::sync::Arc;

use mujoco_rs::wrappers::mj_data::{MjData, MjtWarning};
use mujoco_rs::wrappers::mj_model::MjModel;
use quad_dataset::{Drive, EnvironmentSpec, Noise};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::environment::{Environment, EnvironmentError, Step};

/// Stream of an episode's seed for the initial state.
const RESET_STREAM: u64 = 1;

/// The rules of a task.
pub(super) trait Task: Send + Sync {
    /// Returns the reward of the step just taken, which began with the first two positions at
    /// `from`, and whether it terminated the episode.
    fn judge(&self, from: [f64; 2], simulation: &Simulation) -> (f64, bool);

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
    /// Many share a model.
    data: MjData<Arc<MjModel>>,
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
        let data = MjData::try_new(model)
            .map_err(|error| EnvironmentError::Allocation(error.to_string()))?;
        let observation = vec![0.0; spec.observation_dim];
        Ok(Self { data, robot, task, observation, steps: 0, spec })
    }

    pub fn spec(&self) -> &'static EnvironmentSpec {
        self.spec
    }

    /// Starts an episode, which is a function of its seed and its actions only: from the model's
    /// initial state with noise, and the first two positions that the task draws.
    pub fn reset(&mut self, seed: u64) {
        self.task.begin(seed);
        self.data.reset();
        let (mut qpos, mut qvel) = (self.qpos().to_vec(), self.qvel().to_vec());
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(RESET_STREAM);
        let noise = self.robot.noise;
        let (Noise::Uniform(bound) | Noise::NormalVelocities(bound)) = noise;
        for value in &mut qpos {
            *value += random.random_range(-bound..bound);
        }
        for value in &mut qvel {
            *value += match noise {
                Noise::Uniform(bound) => random.random_range(-bound..bound),
                Noise::NormalVelocities(scale) => scale * random.sample::<f64, _>(StandardNormal),
            };
        }
        if let Some(place) = self.task.start(seed) {
            qpos[..2].copy_from_slice(&place);
        }
        self.set_state(&qpos, &qvel);
    }

    /// Starts an episode in a given state (`nq` positions, `nv` velocities).
    ///
    /// Computes the accelerations, as Gymnasium does after a reset: they warm-start the solver, so
    /// the first step depends on them slightly.
    pub fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.data.reset();
        self.data.qpos_mut().copy_from_slice(qpos);
        self.data.qvel_mut().copy_from_slice(qvel);
        self.data.forward();
        self.steps = 0;
        self.observe();
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
        let is_valid = self.advance(action);
        self.observe();
        let (reward, terminated) = match is_valid {
            true => self.task.judge(from, self),
            false => (0.0, true),
        };
        let is_beyond = action.iter().any(|value| value.abs() > 1.0);
        let clip = || action.iter().map(|value| value.clamp(-1.0, 1.0)).collect();
        Step { reward, terminated, truncated, clipped: is_beyond.then(clip), ..Step::default() }
    }

    /// Returns false if the step failed: a NaN in an action is not applied; if a simulation diverges,
    /// MuJoCo restores the initial state.
    #[must_use]
    fn advance(&mut self, action: &[f32]) -> bool {
        if action.iter().any(|value| value.is_nan()) {
            return false;
        }
        for (i, &value) in action.iter().enumerate() {
            let value = f64::from(value).clamp(-1.0, 1.0);
            match self.robot.drive {
                Drive::Motors => {
                    let [_, strongest] = self.data.model().actuator_ctrlrange()[i];
                    self.data.ctrl_mut()[i] = strongest * value;
                }
                Drive::Displacement(furthest) => {
                    self.data.qpos_mut()[i] += furthest * value;
                    self.data.qvel_mut()[i] = 0.0;
                }
            }
        }
        for _ in 0..self.robot.frame_skip {
            self.data.step();
        }
        let warnings = self.data.warning();
        let bad =
            [MjtWarning::mjWARN_BADQPOS, MjtWarning::mjWARN_BADQVEL, MjtWarning::mjWARN_BADQACC];
        bad.into_iter().all(|warning| warnings[warning as usize].number == 0)
    }

    /// Simulated time of a step, seconds.
    pub fn control_period(&self) -> f64 {
        self.data.model_opt().timestep * self.robot.frame_skip as f64
    }

    /// [observation_dim]
    pub fn observation(&self) -> &[f64] {
        &self.observation
    }

    pub fn qpos(&self) -> &[f64] {
        self.data.qpos()
    }

    pub fn qvel(&self) -> &[f64] {
        self.data.qvel()
    }

    /// The last step's controls, in the motors' own units.
    pub(super) fn controls(&self) -> &[f64] {
        self.data.ctrl()
    }

    fn observe(&mut self) {
        let limit = self.robot.observed_velocity;
        let visible = &self.data.qpos()[self.robot.hidden_positions..];
        let (positions, velocities) = self.observation.split_at_mut(visible.len());
        positions.copy_from_slice(visible);
        for (observed, velocity) in velocities.iter_mut().zip(self.data.qvel()) {
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
