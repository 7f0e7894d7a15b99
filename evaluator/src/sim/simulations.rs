//! Makes environments by their rows in the dataset crate's table ([`EnvironmentSpec`]).

use quad_dataset::environment::{self, EnvironmentSpec};
use quad_dataset::{Drive, Simulator};

use super::environment::{Environment, EnvironmentError, Environments};
use super::maze::{self, Navigation};
use super::physics::{self, Physics};
use super::planar;
use super::simulation::Simulation;

/// The models in `evaluator/assets` by their names, as MJCF, which the build lists.
static MODELS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/models.rs"));

/// Makes the simulation of an environment. Simulations of one model share the compiled model, so a
/// second one costs little.
///
/// `environment_seed` is the seed of what the environment draws once and keeps over all episodes,
/// if anything.
///
/// # Errors
///
/// MuJoCo fails.
pub fn make(
    spec: &'static EnvironmentSpec,
    environment_seed: u64,
) -> Result<Simulation, EnvironmentError> {
    let model = physics::model(spec.simulation(), || mjcf(spec))?;
    let (frame_skip, drive) = match &spec.simulator {
        Simulator::Planar(robot) => (robot.frame_skip, Drive::Motors),
        Simulator::Maze(robot, _) => (robot.frame_skip, robot.drive),
    };
    let physics = Physics::new(model, frame_skip, drive)?;
    Ok(match &spec.simulator {
        Simulator::Planar(robot) => {
            Simulation::new(physics, planar::body(robot), Box::new(robot), spec)
        }
        Simulator::Maze(robot, _) => {
            let task = Navigation::new(spec, environment_seed);
            Simulation::new(physics, maze::body(robot), Box::new(task), spec)
        }
    })
}

/// The environments that this program simulates, for evaluators.
pub struct Simulations;

impl Environments for Simulations {
    fn names(&self) -> Vec<String> {
        environment::names().into_iter().map(str::to_owned).collect()
    }

    fn sizes(&self, name: &str) -> Option<(usize, usize)> {
        environment::find(name).ok().map(|spec| (spec.observation_dim, spec.action_dim))
    }

    fn make(
        &self,
        name: &str,
        environment_seed: u64,
    ) -> Result<Box<dyn Environment>, EnvironmentError> {
        let spec =
            environment::find(name).map_err(|_| EnvironmentError::NotSimulated(name.to_owned()))?;
        Ok(Box::new(make(spec, environment_seed)?))
    }
}

/// The MJCF text that an environment's model is compiled from.
#[allow(clippy::expect_used)] // The table is part of the program, and the test here makes each of its environments.
pub fn mjcf(spec: &EnvironmentSpec) -> String {
    let file = |name: &str| {
        let found = MODELS.iter().find(|(model, _)| *model == name);
        found.expect("evaluator/assets has the model").1
    };
    match spec.simulator {
        Simulator::Planar(_) => file(spec.simulation()).to_owned(),
        Simulator::Maze(robot, map) => maze::mjcf(file(&robot.name), map),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_environment_of_the_table_is_simulated() {
        for spec in environment::all() {
            let environment = make(spec, 0).unwrap();
            let sizes = (
                environment.observation().len(),
                environment.qpos().len(),
                environment.qvel().len(),
            );
            assert_eq!(
                sizes,
                (spec.observation_dim, spec.qpos_dim, spec.qvel_dim),
                "{}",
                spec.name
            );
        }
    }
}
