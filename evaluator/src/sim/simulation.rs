//! A task that this program simulates: it cannot fail, and its state can be set and read.

use super::environment::Step;

/// The stream that initial states are drawn from, among those of an episode's seed.
pub(super) const RESET_STREAM: u64 = 1;
/// The stream that a goal is drawn from, among those of an episode's or an environment's seed.
pub(super) const GOAL_STREAM: u64 = 4;

/// One simulated task, with the semantics of D4RL's files.
///
/// Positions `qpos`, velocities `qvel` and observations are MuJoCo's own `f64`; a rollout rounds them to `f32` for the policy.
pub trait Simulation: Send {
    /// Starts an episode. The noise on the initial state comes from a stream of `seed`, so an episode is a function of its
    /// seed and its actions only.
    fn reset(&mut self, seed: u64);

    /// Starts an episode in a given state (`nq` positions, `nv` velocities).
    fn set_state(&mut self, qpos: &[f64], qvel: &[f64]);

    /// Moves the goal (x and y, metres) until it is drawn again; does nothing in a task without a goal.
    fn set_goal(&mut self, _goal: &[f64]) {}

    /// The position of the goal (x and y, metres), in a task that has one.
    fn goal(&self) -> Option<&[f64]> {
        None
    }

    /// Applies `action` (`action_dim` values, clipped to [-1, 1]) for one control period.
    fn step(&mut self, action: &[f32]) -> Step;

    /// Simulated time of a step, seconds.
    fn control_period(&self) -> f64;

    /// The current observation, `observation_dim` values.
    fn observation(&self) -> &[f64];

    /// The current generalised positions.
    fn qpos(&self) -> &[f64];

    /// The current generalised velocities.
    fn qvel(&self) -> &[f64];
}
