//! Makes environments by their rows in the dataset crate's table ([`EnvironmentSpec`]).

use quad_dataset::Simulator;
use quad_dataset::environment::{self, EnvironmentSpec};

use super::environment::{Environment, EnvironmentError, Environments};
use super::maze::{self, Navigation};
use super::physics;
use super::planar;
use super::simulation::{Simulation, Task};

/// The models in `evaluator/assets` by their names, as MJCF, which the build lists.
static MODELS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/models.rs"));

/// Makes the simulation of an environment. Simulations of one model share the compiled model.
/// `environment_seed` decides what the environment draws once for all episodes, if anything.
pub fn make(
    spec: &'static EnvironmentSpec,
    environment_seed: u64,
) -> Result<Simulation, EnvironmentError> {
    let model = physics::model(spec.simulation(), || mjcf(spec))?;
    let (robot, task): (_, Box<dyn Task>) = match &spec.simulator {
        Simulator::Planar(planar) => (planar::robot(planar), Box::new(planar)),
        Simulator::Maze(robot, _) => {
            let task = Navigation::new(spec, environment_seed);
            (maze::robot(robot), Box::new(task))
        }
    };
    Simulation::new(model, robot, task, spec)
}

/// The environments that this program simulates, for evaluators.
pub struct Simulations;

impl Environments for Simulations {
    fn names(&self) -> Vec<String> {
        environment::names().into_iter().map(str::to_owned).collect()
    }

    fn sizes(&self, name: &str) -> Option<(usize, usize)> {
        let spec = environment::find(name).ok()?;
        Some((spec.observation_dim, spec.action_dim))
    }

    fn make(
        &self,
        name: &str,
        environment_seed: u64,
    ) -> Result<Box<dyn Environment>, EnvironmentError> {
        let unknown = |_| EnvironmentError::NotSimulated(name.to_owned());
        let spec = environment::find(name).map_err(unknown)?;
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
            let simulation = make(spec, 0).unwrap();
            let sizes = [simulation.observation(), simulation.qpos(), simulation.qvel()];
            let expected = [spec.observation_dim, spec.qpos_dim, spec.qvel_dim];
            assert_eq!(sizes.map(<[f64]>::len), expected, "{}", spec.name);
        }
    }
}
