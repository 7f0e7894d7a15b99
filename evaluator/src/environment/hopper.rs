//! Hopper: one leg, hopping forward in a plane.

use std::sync::{Arc, OnceLock};

use mujoco_rs::wrappers::mj_model::MjModel;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::physics::{self, Physics};
use super::{Environment, EnvironmentError, RESET_STREAM, Step};

const OBSERVATION_DIM: usize = 11;
const ACTION_DIM: usize = 3;

/// Model steps a control is held for: 4 × 0.002 s.
const FRAME_SKIP: usize = 4;
/// Half width of the uniform noise on every initial position and velocity.
const RESET_NOISE: f64 = 5e-3;
/// Paid at every step, also at the one that ends the episode.
const ALIVE_BONUS: f64 = 1.0;
const CONTROL_COST: f64 = 1e-3;
/// Bound on each velocity as it is observed.
const OBSERVED_VELOCITY: f64 = 10.0;

/// D4RL's Hopper-v2 = Gymnasium's Hopper-v4.
///
/// - qpos (6): x, z, pitch, hip, knee, ankle; qvel (6): their velocities. Metres and radians, per second.
/// - Observation (11): qpos without x, then qvel clipped to ±10.
/// - Action (3): torques of hip, knee and ankle as fractions of 200 Nm, clipped to ±1.
/// - Reward: x's mean velocity over the control period + 1 - 0.001 · Σ a², with the clipped action.
/// - The episode is terminated unless z > 0.7, |pitch| < 0.2, and every other position and velocity lies within ±100;
///   truncated after `max_episode_steps` (1000).
///
/// What Gymnasium leaves to chance ends the episode here, with no reward for that step: a simulation that diverged,
/// and an action that is not a number (which is not applied). So a return is finite whatever the policy does.
pub struct Hopper {
    physics: Physics,
    observation: [f64; OBSERVATION_DIM],
    steps: usize,
    max_episode_steps: usize,
}

impl Hopper {
    /// A hopper that waits for its first [`reset`](Environment::reset).
    pub(super) fn new(max_episode_steps: usize) -> Result<Self, EnvironmentError> {
        let physics = Physics::new(Self::model()?, FRAME_SKIP)?;
        Ok(Self { physics, observation: [0.0; OBSERVATION_DIM], steps: 0, max_episode_steps })
    }

    /// The compiled model, shared by all hoppers of the process.
    fn model() -> Result<Arc<MjModel>, EnvironmentError> {
        static MODEL: OnceLock<Arc<MjModel>> = OnceLock::new();
        if let Some(model) = MODEL.get() {
            return Ok(Arc::clone(model));
        }
        let model = physics::compile("hopper", include_str!("../../assets/hopper.xml"))?;
        Ok(Arc::clone(MODEL.get_or_init(|| model)))
    }

    fn start(&mut self, init: impl FnOnce(&mut [f64], &mut [f64])) {
        self.physics.reset(init);
        self.steps = 0;
        self.observe();
    }

    fn observe(&mut self) {
        let (positions, velocities) = self.observation.split_at_mut(self.physics.qpos().len() - 1);
        positions.copy_from_slice(&self.physics.qpos()[1..]);
        for (observed, velocity) in velocities.iter_mut().zip(self.physics.qvel()) {
            *observed = velocity.clamp(-OBSERVED_VELOCITY, OBSERVED_VELOCITY);
        }
    }

    /// False for anything that is not a number, too: no comparison with it holds.
    fn is_healthy(&self) -> bool {
        let (qpos, qvel) = (self.physics.qpos(), self.physics.qvel());
        let (z, pitch) = (qpos[1], qpos[2]);
        let bounded = qpos[2..].iter().chain(qvel).all(|value| value.abs() < 100.0);
        bounded && z > 0.7 && z < f64::INFINITY && pitch.abs() < 0.2
    }
}

impl Environment for Hopper {
    fn reset(&mut self, seed: u64) {
        let mut noise = ChaCha8Rng::seed_from_u64(seed);
        noise.set_stream(RESET_STREAM);
        self.start(|qpos, qvel| {
            for value in qpos.iter_mut().chain(qvel) {
                *value += noise.random_range(-RESET_NOISE..RESET_NOISE);
            }
        });
    }

    fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.start(|positions, velocities| {
            positions.copy_from_slice(qpos);
            velocities.copy_from_slice(qvel);
        });
    }

    fn step(&mut self, action: &[f32]) -> Step {
        self.steps += 1;
        let truncated = self.steps >= self.max_episode_steps;
        let mut controls = [0.0; ACTION_DIM];
        for (control, &value) in controls.iter_mut().zip(action) {
            *control = f64::from(value).clamp(-1.0, 1.0);
        }
        let x = self.physics.qpos()[0];
        if controls.iter().any(|control| control.is_nan()) || !self.physics.step(&controls) {
            self.observe();
            return Step { reward: 0.0, terminated: true, truncated };
        }
        self.observe();
        let velocity = (self.physics.qpos()[0] - x) / self.physics.dt();
        let cost = CONTROL_COST * controls.iter().map(|control| control * control).sum::<f64>();
        Step { reward: velocity + ALIVE_BONUS - cost, terminated: !self.is_healthy(), truncated }
    }

    fn observation(&self) -> &[f64] {
        &self.observation
    }

    fn qpos(&self) -> &[f64] {
        self.physics.qpos()
    }

    fn qvel(&self) -> &[f64] {
        self.physics.qvel()
    }
}
