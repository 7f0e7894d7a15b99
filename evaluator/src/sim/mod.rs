//! Simulation: environments, which are made here by their rows in the dataset crate's table
//! ([`EnvironmentSpec`]), and batches of episodes.
//!
//! Owns the compiled MuJoCo models, which the process shares. Everything runs on the calling
//! thread; a rollout shares the physics among rayon's threads.
//!
//! # Layout
//!
//! - `environment`: the traits of an environment; `simulation`: one that this program simulates, by
//!   MuJoCo.
//! - `planar` (Hopper, HalfCheetah, Walker2d), `maze`: the tasks, with the rules that D4RL's scores
//!   are defined by.
//! - `rollout`: many episodes as one batch, one policy call for each step.

mod environment;
mod maze;
mod planar;
mod rollout;
mod simulation;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, Once, PoisonError};

use mujoco_rs::logging::set_log_handler;
use mujoco_rs::wrappers::mj_logging::MjLogMessage;
use mujoco_rs::wrappers::mj_model::MjModel;
use quad_dataset::Simulator;
use quad_dataset::environment::{EnvironmentSpec, find, names};

pub use environment::{Environment, EnvironmentError, Environments, Step};
use maze::Navigation;
pub use rollout::{Rollout, Stepped};
pub use simulation::Simulation;
use simulation::Task;

/// The models in `evaluator/assets` by their names, as MJCF, which the build lists.
static MODELS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/models.rs"));

/// Makes the simulation of an environment. Simulations of one model share the compiled model.
/// `environment_seed` decides what the environment draws once for all episodes, if anything.
pub fn make(
    spec: &'static EnvironmentSpec,
    environment_seed: u64,
) -> Result<Simulation, EnvironmentError> {
    let model = model(spec.simulation(), || mjcf(spec))?;
    let (robot, task): (_, Box<dyn Task>) = match &spec.simulator {
        Simulator::Planar(planar) => (planar::robot(planar), Box::new(planar)),
        Simulator::Maze(robot, _) => {
            let task = Navigation::new(spec, environment_seed);
            (maze::robot(robot), Box::new(task))
        }
    };
    Simulation::new(model, robot, task, spec)
}

/// The compiled model of a simulation, which the process shares. `mjcf` makes its text.
fn model(
    simulation: &'static str,
    mjcf: impl FnOnce() -> String,
) -> Result<Arc<MjModel>, EnvironmentError> {
    static MODELS: Mutex<BTreeMap<&str, Arc<MjModel>>> = Mutex::new(BTreeMap::new());
    static LOGGING: Once = Once::new();
    let mut models = MODELS.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(model) = models.get(simulation) {
        return Ok(Arc::clone(model));
    }
    // SAFETY: every use of MuJoCo starts with a compiled model, so none runs before this.
    LOGGING.call_once(|| unsafe { set_log_handler(log) });
    let model = MjModel::from_xml_string(&mjcf())
        .map_err(|error| EnvironmentError::Model { simulation, reason: error.to_string() })?;
    Ok(Arc::clone(models.entry(simulation).or_insert(Arc::new(model))))
}

/// Replaces MuJoCo's own handler, which appends to `MUJOCO_LOG.TXT` in the working directory.
fn log(message: &MjLogMessage) {
    tracing::debug!(target: "mujoco", "{}", message.subject());
}

/// The environments that this program simulates, for evaluators.
pub struct Simulations;

impl Environments for Simulations {
    fn names(&self) -> Vec<String> {
        names().into_iter().map(str::to_owned).collect()
    }

    fn sizes(&self, name: &str) -> Option<(usize, usize)> {
        let spec = find(name).ok()?;
        Some((spec.observation_dim, spec.action_dim))
    }

    fn make(
        &self,
        name: &str,
        environment_seed: u64,
    ) -> Result<Box<dyn Environment>, EnvironmentError> {
        let unknown = |_| EnvironmentError::NotSimulated(name.to_owned());
        let spec = find(name).map_err(unknown)?;
        Ok(Box::new(make(spec, environment_seed)?))
    }
}

/// The MJCF text that an environment's model is compiled from.
#[allow(clippy::expect_used)] // The table is part of the program, and a test makes each of its environments.
pub fn mjcf(spec: &EnvironmentSpec) -> String {
    let file = |name: &str| {
        let listed = MODELS.iter().find(|(model, _)| *model == name);
        listed.expect("evaluator/assets has the model").1
    };
    match spec.simulator {
        Simulator::Planar(_) => file(spec.simulation()).to_owned(),
        Simulator::Maze(robot, map) => maze::mjcf(file(&robot.name), map),
    }
}
