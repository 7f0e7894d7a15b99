//! Makes environments by their rows in the dataset crate's table ([`EnvironmentSpec`]).

use quad_dataset::Planar;
use quad_dataset::environment::{self, EnvironmentSpec, Goal};

use super::antmaze::{self, AntMaze, Maze};
use super::environment::{Environment, EnvironmentError, Environments};
use super::physics::{self, Physics};
use super::planar;
use super::simulation::Simulation;

/// The models in `evaluator/assets` by their names, as MJCF, which the build lists.
static MODELS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/models.rs"));

/// What simulates an environment, and the name that its compiled model is kept under.
struct Kind {
    name: &'static str,
    rules: Rules,
}

enum Rules {
    Planar(&'static Planar),
    Maze(Maze),
}

impl Kind {
    fn of(spec: &EnvironmentSpec) -> Result<Self, EnvironmentError> {
        let row = environment::find(spec.simulation()).ok();
        let planar = row.and_then(|row| row.planar.as_ref()).map(Rules::Planar);
        let rules = planar.or_else(|| row?.maze.as_deref().map(|map| Rules::Maze(Maze(map))));
        let not_simulated = || EnvironmentError::NotSimulated(spec.simulation().to_owned());
        let (row, rules) = row.zip(rules).ok_or_else(not_simulated)?;
        Ok(Self { name: &row.name, rules })
    }

    fn mjcf(&self) -> Result<String, EnvironmentError> {
        let file = |name: &str| {
            let found = MODELS.iter().find(|(model, _)| *model == name).map(|(_, mjcf)| *mjcf);
            let reason = || format!("evaluator/assets/{name}.xml is missing");
            found.ok_or_else(|| EnvironmentError::Model { simulation: self.name, reason: reason() })
        };
        match self.rules {
            Rules::Planar(_) => file(self.name).map(str::to_owned),
            Rules::Maze(maze) => file("ant").map(|ant| maze.mjcf(ant)),
        }
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
pub fn make(spec: &'static EnvironmentSpec, environment_seed: u64) -> Result<Simulation, EnvironmentError> {
    let kind = Kind::of(spec)?;
    let model = physics::model(kind.name, || kind.mjcf())?;
    Ok(match kind.rules {
        Rules::Planar(robot) => {
            Simulation::new(Physics::new(model, robot.frame_skip)?, planar::body(robot), Box::new(robot), spec)
        }
        Rules::Maze(maze) => {
            let task = AntMaze::new(maze, spec.goal.unwrap_or(Goal::EachEpisode), environment_seed);
            Simulation::new(Physics::new(model, antmaze::FRAME_SKIP)?, antmaze::BODY, Box::new(task), spec)
        }
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
        Ok(Box::new(make(spec, environment_seed)?))
    }
}

/// The MJCF text that an environment's model is compiled from.
///
/// # Errors
/// This program does not simulate the environment.
pub fn mjcf(spec: &EnvironmentSpec) -> Result<String, EnvironmentError> {
    Kind::of(spec)?.mjcf()
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
            "max_episode_steps": 200, "reference_returns": [0.0, 1.0], "reward": "locomotion", "collect": {"none": "a test"},
        }))
        .unwrap();
        let error = make(Box::leak(Box::new(spec)), 0).err().unwrap();
        assert!(matches!(&error, EnvironmentError::NotSimulated(name) if name == "cartpole"), "{error}");
    }
}
