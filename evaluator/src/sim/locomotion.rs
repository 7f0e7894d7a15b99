//! Hopper, HalfCheetah and Walker2d: robots in a vertical plane, rewarded for running along x.
//!
//! They are D4RL's locomotion-v2 tasks, gym's "-v2" and Gymnasium's "-v4", and differ in a model and a few constants:
//!
//! - qpos: x, z and pitch of the torso, then the joints from the hip down (HalfCheetah: the back leg first; Walker2d:
//!   the right one); qvel: their velocities. Metres and radians, per second.
//! - Observation: qpos without x, then qvel, clipped to ±10 (not for HalfCheetah).
//! - Action: torques of the joints in that order, as fractions of the motors' strongest, clipped to ±1.
//! - Reward: x's mean velocity over the control period, plus 1 for Hopper and Walker2d, minus `control_cost` · Σ a², with the
//!   clipped action. Every step earns the 1, also the step that ends the episode.
//! - The episode terminates when the robot is not healthy, and is truncated after `max_episode_steps`.
//!
//! Gymnasium does not handle two cases, which here end the episode without reward for that step: a simulation that diverges,
//! and an action that is not a number (which is not applied). So every return is finite.

use quad_dataset::environment::EnvironmentSpec;

use super::environment::{EnvironmentError, Step};
use super::physics::{self, Noise, Physics};
use super::simulation::Simulation;

/// What distinguishes the robots.
pub(super) struct Robot {
    /// The simulation's name in the table of environments.
    pub name: &'static str,
    /// Its model, as MJCF.
    pub mjcf: &'static str,
    /// Model steps a control is held for.
    frame_skip: usize,
    /// Noise on the initial state.
    noise: Noise,
    /// Reward of every step.
    alive_bonus: f64,
    /// Cost of a squared action.
    control_cost: f64,
    /// Limit of each observed velocity.
    observed_velocity: f64,
    /// Whether the episode continues, given qpos and qvel. False for NaN, because no comparison with NaN holds.
    is_healthy: fn(&[f64], &[f64]) -> bool,
}

pub(super) static ROBOTS: [Robot; 3] = [
    Robot {
        name: "hopper",
        mjcf: include_str!("../../assets/hopper.xml"),
        frame_skip: 4, // × 0.002 s
        noise: Noise::Uniform(5e-3),
        alive_bonus: 1.0,
        control_cost: 1e-3,
        observed_velocity: 10.0,
        is_healthy: |qpos, qvel| {
            let (z, pitch) = (qpos[1], qpos[2]);
            let bounded = qpos[2..].iter().chain(qvel).all(|value| value.abs() < 100.0);
            bounded && z > 0.7 && z < f64::INFINITY && pitch.abs() < 0.2
        },
    },
    Robot {
        name: "halfcheetah",
        mjcf: include_str!("../../assets/halfcheetah.xml"),
        frame_skip: 5, // × 0.01 s
        noise: Noise::NormalVelocities(0.1),
        alive_bonus: 0.0,
        control_cost: 0.1,
        observed_velocity: f64::INFINITY,
        is_healthy: |_, _| true,
    },
    Robot {
        name: "walker2d",
        mjcf: include_str!("../../assets/walker2d.xml"),
        frame_skip: 4, // × 0.002 s
        noise: Noise::Uniform(5e-3),
        alive_bonus: 1.0,
        control_cost: 1e-3,
        observed_velocity: 10.0,
        is_healthy: |qpos, _| {
            let (z, pitch) = (qpos[1], qpos[2]);
            z > 0.8 && z < 2.0 && pitch.abs() < 1.0
        },
    },
];

/// One robot on its plane.
pub(super) struct Locomotion {
    robot: &'static Robot,
    physics: Physics,
    observation: Vec<f64>,
    steps: usize,
    max_episode_steps: usize,
}

impl Locomotion {
    /// A robot that waits for its first [`reset`](Simulation::reset).
    pub fn new(robot: &'static Robot, spec: &EnvironmentSpec) -> Result<Self, EnvironmentError> {
        let model = physics::model(robot.name, || robot.mjcf.to_owned())?;
        Ok(Self {
            robot,
            physics: Physics::new(model, robot.frame_skip)?,
            observation: vec![0.0; spec.observation_dim],
            steps: 0,
            max_episode_steps: spec.max_episode_steps,
        })
    }

    fn observe(&mut self) {
        let bound = self.robot.observed_velocity;
        let (positions, velocities) = self.observation.split_at_mut(self.physics.qpos().len() - 1);
        positions.copy_from_slice(&self.physics.qpos()[1..]);
        for (observed, velocity) in velocities.iter_mut().zip(self.physics.qvel()) {
            *observed = velocity.clamp(-bound, bound);
        }
    }
}

impl Simulation for Locomotion {
    fn reset(&mut self, seed: u64) {
        self.physics.reset(seed, self.robot.noise);
        self.steps = 0;
        self.observe();
    }

    fn set_state(&mut self, qpos: &[f64], qvel: &[f64]) {
        self.physics.set_state(qpos, qvel);
        self.steps = 0;
        self.observe();
    }

    fn step(&mut self, action: &[f32]) -> Step {
        self.steps += 1;
        let truncated = self.steps >= self.max_episode_steps;
        let x = self.physics.qpos()[0];
        let went_on = self.physics.step(action);
        self.observe();
        if !went_on {
            return Step { reward: 0.0, terminated: true, truncated };
        }
        let velocity = (self.physics.qpos()[0] - x) / self.physics.dt();
        let cost =
            self.robot.control_cost * self.physics.controls().iter().map(|control| control * control).sum::<f64>();
        let terminated = !(self.robot.is_healthy)(self.physics.qpos(), self.physics.qvel());
        Step { reward: velocity + self.robot.alive_bonus - cost, terminated, truncated }
    }

    fn control_period(&self) -> f64 {
        self.physics.dt()
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
