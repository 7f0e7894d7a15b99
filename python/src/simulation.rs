//! `quad_rl.Simulation`: an environment of `evaluator serve`, in any state.

use std::fmt::Display;

use numpy::PyReadonlyArray1;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use quad_dataset::environment;
use quad_evaluator::sim::{self, Simulation};

/// An environment that `evaluator serve` simulates, such as "hopper". Its `state` can be read and
/// set: MuJoCo's qpos and qvel, and the goal's x and y, or None. A set state begins an episode.
///
/// seed: the run's, which decides what the environment draws once for all episodes.
#[pyclass(name = "Simulation", module = "quad_rl")]
pub struct PySimulation(Simulation);

type State = (Vec<f64>, Vec<f64>, Option<Vec<f64>>);

#[pymethods]
impl PySimulation {
    #[new]
    #[pyo3(signature = (environment, seed = 0))]
    fn new(environment: &str, seed: u64) -> PyResult<Self> {
        let spec = environment::find(environment).map_err(refused)?;
        sim::make(spec, seed).map(Self).map_err(refused)
    }

    /// Starts the episode of a seed.
    fn reset(&mut self, seed: u64) {
        self.0.reset(seed);
    }

    /// Applies an action, float32: (reward, terminated, truncated).
    fn step(&mut self, action: PyReadonlyArray1<'_, f32>) -> PyResult<(f64, bool, bool)> {
        let action = action.as_slice()?;
        check("action", action.len(), self.0.spec().action_dim)?;
        let step = self.0.step(action);
        Ok((step.reward, step.terminated, step.truncated))
    }

    #[getter]
    fn observation(&self) -> &[f64] {
        self.0.observation()
    }

    #[getter]
    fn state(&self) -> State {
        let goal = self.0.goal().map(<[f64]>::to_vec);
        (self.0.qpos().to_vec(), self.0.qvel().to_vec(), goal)
    }

    #[setter]
    fn set_state(&mut self, state: State) -> PyResult<()> {
        let (qpos, qvel, goal) = state;
        check("qpos", qpos.len(), self.0.qpos().len())?;
        check("qvel", qvel.len(), self.0.qvel().len())?;
        if let Some(goal) = goal {
            check("goal", goal.len(), 2)?;
            self.0.set_goal(&goal);
        }
        self.0.set_state(&qpos, &qvel);
        Ok(())
    }
}

fn check(name: &str, length: usize, expected: usize) -> PyResult<()> {
    let error = || refused(format!("{name} has {length} numbers, not {expected}"));
    (length == expected).then_some(()).ok_or_else(error)
}

fn refused(error: impl Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}
