//! Makes environments by their names in the dataset crate's table
//! ([`EnvironmentSpec`](quad_dataset::environment::EnvironmentSpec)), which has a task's sizes, time limit and score references.

use quad_dataset::environment::{self, EnvironmentSpec};

use super::antmaze::{AntMaze, MAZES, Maze};
use super::environment::{Environment, EnvironmentError, Environments, Step};
use super::locomotion::{Locomotion, ROBOTS, Robot};
use super::simulation::Simulation;

/// What simulates an environment.
enum Kind {
    Locomotion(&'static Robot),
    AntMaze(&'static Maze),
}

impl Kind {
    fn of(spec: &EnvironmentSpec) -> Result<Self, EnvironmentError> {
        let name = spec.simulation();
        let robot = ROBOTS.iter().find(|robot| robot.name == name).map(Self::Locomotion);
        let maze = MAZES.iter().find(|maze| maze.name == name).map(Self::AntMaze);
        robot.or(maze).ok_or_else(|| EnvironmentError::NotSimulated(name.to_owned()))
    }
}

/// The environments of the table that [`make`] can make.
pub fn simulated() -> impl Iterator<Item = &'static EnvironmentSpec> {
    environment::all().iter().filter(|spec| Kind::of(spec).is_ok())
}

/// Makes the simulation of an environment. Simulations of one model share the compiled model, so a second one costs little.
///
/// `environment_seed` is the seed of what the environment draws once and keeps over all episodes, if anything.
///
/// # Errors
///
/// This program does not simulate the environment, or MuJoCo fails.
pub fn make(spec: &EnvironmentSpec, environment_seed: u64) -> Result<Box<dyn Simulation>, EnvironmentError> {
    Ok(match Kind::of(spec)? {
        Kind::Locomotion(robot) => Box::new(Locomotion::new(robot, spec)?),
        Kind::AntMaze(maze) => Box::new(AntMaze::new(maze, spec, environment_seed)?),
    })
}

/// The environments that this program simulates, for evaluators.
pub struct Simulations;

impl Environments for Simulations {
    fn names(&self) -> Vec<String> {
        simulated().map(|spec| spec.name.clone()).collect()
    }

    fn sizes(&self, name: &str) -> Option<(usize, usize)> {
        environment::find(name).ok().map(|spec| (spec.observation_dim, spec.action_dim))
    }

    fn make(&self, name: &str, environment_seed: u64) -> Result<Box<dyn Environment>, EnvironmentError> {
        let spec = environment::find(name).map_err(|_| EnvironmentError::NotSimulated(name.to_owned()))?;
        Ok(Box::new(Simulated { simulation: make(spec, environment_seed)?, spec }))
    }
}

/// A simulation of this program as an environment, with D4RL's normalised score.
struct Simulated {
    simulation: Box<dyn Simulation>,
    spec: &'static EnvironmentSpec,
}

impl Environment for Simulated {
    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        self.simulation.reset(seed);
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        Ok(self.simulation.step(action))
    }

    fn observation(&self) -> &[f64] {
        self.simulation.observation()
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        Ok(self.spec.normalised_score(episode_return))
    }
}

/// The MJCF text that an environment's model is compiled from.
///
/// # Errors
/// This program does not simulate the environment.
pub fn mjcf(spec: &EnvironmentSpec) -> Result<String, EnvironmentError> {
    Ok(match Kind::of(spec)? {
        Kind::Locomotion(robot) => robot.mjcf.to_owned(),
        Kind::AntMaze(maze) => maze.mjcf(),
    })
}

#[cfg(test)]
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
