//! Environments: what a policy acts in.
//!
//! A task's name, sizes, time limit and score references are the dataset crate's
//! [`EnvironmentSpec`](quad_dataset::environment::EnvironmentSpec); here is how it moves. Reading order: `locomotion`
//! (Hopper, HalfCheetah, Walker2d), `antmaze`, and `physics`, which drives MuJoCo.

mod antmaze;
mod locomotion;
mod physics;

use antmaze::{AntMaze, MAZES, Maze};
use locomotion::{Locomotion, ROBOTS, Robot};
use quad_dataset::environment::{self, EnvironmentSpec};
use thiserror::Error;

/// The stream that initial states are drawn from, among those of an episode's seed.
const RESET_STREAM: u64 = 1;
/// The stream that a goal is drawn from, among those of an episode's or an instance's seed.
const GOAL_STREAM: u64 = 4;

/// What one step of an environment gave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// The reward of this step.
    pub reward: f64,
    /// The task ended the episode here: there is no future to bootstrap from.
    pub terminated: bool,
    /// The time limit was reached here. Independent of `terminated`, as in Gymnasium: both may be true.
    pub truncated: bool,
}

/// One simulated task, with the semantics of D4RL's locomotion-v2 files (Gymnasium's "-v4").
///
/// Positions `qpos`, velocities `qvel` and observations are MuJoCo's own `f64`; they are rounded to `f32` for the policy.
pub trait Environment: Send {
    /// Starts an episode: the initial state's noise is drawn from a stream of `seed`'s own, so an episode is a
    /// function of its seed and its actions alone.
    fn reset(&mut self, seed: u64);

    /// Starts an episode in a given state (`nq` positions, `nv` velocities).
    fn set_state(&mut self, qpos: &[f64], qvel: &[f64]);

    /// Puts the goal somewhere (x and y, metres) until it is drawn again; does nothing where there is none.
    fn set_goal(&mut self, _goal: &[f64]) {}

    /// Applies `action` (`action_dim` values, clipped to [-1, 1]) for one control period.
    fn step(&mut self, action: &[f32]) -> Step;

    /// The current observation, `observation_dim` values.
    fn observation(&self) -> &[f64];

    /// The current generalised positions.
    fn qpos(&self) -> &[f64];

    /// The current generalised velocities.
    fn qvel(&self) -> &[f64];
}

/// How an environment moves.
enum Simulation {
    Locomotion(&'static Robot),
    AntMaze(&'static Maze),
}

impl Simulation {
    fn of(spec: &EnvironmentSpec) -> Result<Self, EnvironmentError> {
        let name = spec.simulation();
        let robot = ROBOTS.iter().find(|robot| robot.name == name).map(Self::Locomotion);
        let maze = MAZES.iter().find(|maze| maze.name == name).map(Self::AntMaze);
        robot.or(maze).ok_or_else(|| EnvironmentError::NotSimulated(name.to_owned()))
    }
}

/// The environments of the table that [`make`] makes.
pub fn simulated() -> impl Iterator<Item = &'static EnvironmentSpec> {
    environment::all().iter().filter(|spec| Simulation::of(spec).is_ok())
}

/// Makes an environment. Those of one simulation share one compiled model, so the second costs little.
///
/// `instance` is the seed of what it draws once and keeps over all episodes, if there is any such thing.
///
/// # Errors
///
/// There is no simulation of the environment, or MuJoCo fails.
pub fn make(spec: &EnvironmentSpec, instance: u64) -> Result<Box<dyn Environment>, EnvironmentError> {
    Ok(match Simulation::of(spec)? {
        Simulation::Locomotion(robot) => Box::new(Locomotion::new(robot, spec)?),
        Simulation::AntMaze(maze) => Box::new(AntMaze::new(maze, spec, instance)?),
    })
}

/// The MJCF text that an environment's model is compiled from.
///
/// # Errors
///
/// There is no simulation of the environment.
pub fn mjcf(spec: &EnvironmentSpec) -> Result<String, EnvironmentError> {
    Ok(match Simulation::of(spec)? {
        Simulation::Locomotion(robot) => robot.mjcf.to_owned(),
        Simulation::AntMaze(maze) => maze.mjcf(),
    })
}

/// Why an environment could not be made.
#[derive(Debug, Error)]
pub enum EnvironmentError {
    /// The name is known to the dataset crate, but this evaluator has no simulation of it.
    #[error("this evaluator cannot simulate the environment \"{0}\"")]
    NotSimulated(String),
    /// MuJoCo refused the embedded model: the library is not the version this was built for.
    #[error("MuJoCo could not compile the model of \"{simulation}\": {reason}")]
    Model {
        /// Whose model.
        simulation: &'static str,
        /// MuJoCo's own words.
        reason: String,
    },
    /// MuJoCo could not allocate the state of a simulation.
    #[error("MuJoCo could not allocate the state of a simulation: {0}")]
    Allocation(String),
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn every_environment_of_the_table_is_simulated() {
        let names: Vec<&str> = simulated().map(|spec| spec.name.as_str()).collect();
        assert_eq!(names, environment::names());
        for spec in simulated() {
            let environment = make(spec, 0).unwrap();
            let sizes = (environment.observation().len(), environment.qpos().len(), environment.qvel().len());
            assert_eq!(sizes, (spec.observation_dim, spec.qpos_dim, spec.qvel_dim), "{}", spec.name);
        }
    }

    #[test]
    fn an_environment_without_simulation_is_refused() {
        let spec: EnvironmentSpec = serde_json::from_value(serde_json::json!({
            "name": "cartpole", "observation_dim": 4, "action_dim": 1, "qpos_dim": 2, "qvel_dim": 2,
            "max_episode_steps": 200, "reference_returns": [0.0, 1.0], "reward": "locomotion",
        }))
        .unwrap();
        let error = make(&spec, 0).err().unwrap();
        assert!(matches!(&error, EnvironmentError::NotSimulated(name) if name == "cartpole"), "{error}");
    }
}
