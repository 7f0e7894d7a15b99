//! Robots in a vertical plane, rewarded for running along x: Hopper, HalfCheetah, Walker2d, and any
//! other with a row `planar` in the table of environments.
//!
//! The three are D4RL's locomotion-v2 tasks, gym's "-v2" and Gymnasium's "-v4", or else Gymnasium's
//! "-v5". They differ in a model and the numbers of their rows:
//!
//! - qpos: x, z and pitch of the torso, then the joints from the hip down (HalfCheetah: the back
//!   leg first; Walker2d: the right one); qvel: their velocities. Meters and radians, per second.
//! - Observation: qpos without x, then qvel, clipped to ± `observed_velocity`.
//! - Action: torques of the joints in that order, as fractions of the motors' strongest, clipped to
//!   ±1.
//! - Reward: x's mean velocity over the control period, plus `alive_bonus`, minus `control_cost` ·
//!   Σ a², with the clipped action. The step that ends the episode earns the bonus only with
//!   `bonus_at_end`.
//! - The episode terminates when the robot is not `healthy`, and is truncated after
//!   `max_episode_steps`.

use quad_dataset::{Drive, Planar};

use super::simulation::{RobotSpec, Simulation, Task};

pub(super) fn robot(planar: &Planar) -> RobotSpec {
    RobotSpec {
        frame_skip: planar.frame_skip,
        drive: Drive::Motors,
        noise: planar.noise,
        hidden_positions: 1,
        observed_velocity: planar.observed_velocity,
    }
}

impl Task for &'static Planar {
    fn judge(&self, [x, _]: [f64; 2], simulation: &Simulation) -> (f64, bool) {
        let (qpos, qvel) = (simulation.qpos(), simulation.qvel());
        let velocity = (qpos[0] - x) / simulation.control_period();
        let squares = simulation.controls().iter().map(|control| control * control);
        let cost = self.control_cost * squares.sum::<f64>();
        let healthy = self.healthy.as_ref();
        let terminated = healthy.is_some_and(|healthy| !healthy.contains(qpos, qvel));
        let is_paid = self.bonus_at_end || !terminated;
        let bonus = if is_paid { self.alive_bonus } else { 0.0 };
        (velocity + bonus - cost, terminated)
    }
}
