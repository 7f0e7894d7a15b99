//! Makes environments by their rows in the dataset crate's table ([`EnvironmentSpec`]).

use quad_dataset::Planar;
use quad_dataset::environment::{self, EnvironmentSpec};

use super::environment::{Environment, EnvironmentError, Environments};
use super::maze::{self, Maze, Navigation, Robot};
use super::physics::{self, Drive, Physics};
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
    #[allow(clippy::expect_used)] // The table is part of the program, and the test here makes each of its environments.
    fn of(spec: &EnvironmentSpec) -> Self {
        let row = environment::find(spec.simulation()).expect("a simulation is a row of the table");
        let planar = row.planar.as_ref().map(Rules::Planar);
        let rules = planar.or_else(|| row.maze.as_deref().map(|map| Rules::Maze(Maze(map))));
        Self { name: &row.name, rules: rules.expect("its row is a planar robot or a maze") }
    }

    #[allow(clippy::expect_used)] // As above.
    fn mjcf(&self) -> String {
        let file = |name: &str| {
            let found = MODELS.iter().find(|(model, _)| *model == name);
            found.expect("evaluator/assets has the model").1
        };
        match self.rules {
            Rules::Planar(_) => file(self.name).to_owned(),
            Rules::Maze(maze) => maze.mjcf(file(Robot::of(self.name).model)),
        }
    }
}

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
    let kind = Kind::of(spec);
    let model = physics::model(kind.name, || kind.mjcf())?;
    Ok(match kind.rules {
        Rules::Planar(robot) => Simulation::new(
            Physics::new(model, robot.frame_skip, Drive::Motors)?,
            planar::body(robot),
            Box::new(robot),
            spec,
        ),
        Rules::Maze(maze) => {
            let (task, drive) =
                (Navigation::new(maze, spec, environment_seed), Robot::of(kind.name).drive);
            Simulation::new(
                Physics::new(model, maze::FRAME_SKIP, drive)?,
                maze::BODY,
                Box::new(task),
                spec,
            )
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
pub fn mjcf(spec: &EnvironmentSpec) -> String {
    Kind::of(spec).mjcf()
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
