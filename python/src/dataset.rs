//! Datasets, for `quad_rl.Dataset`, and run folders, for `quad_rl.runs`.

use std::path::PathBuf;

use numpy::{PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use quad_dataset::{Arrays, DatasetError, Names, benchmarks, inspect, write_own};
use quad_run::results::RunReport;
use quad_runtime::one_line;

use crate::error::with_hint;

fn refused(error: &DatasetError) -> PyErr {
    with_hint(error, &error.hint())
}

/// Writes a file of our own layout. All arrays are C-contiguous and have the same number of rows;
/// names may be empty lists.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "they are the file's arrays")]
pub fn write_dataset(
    py: Python<'_>,
    path: PathBuf,
    observations: PyReadonlyArray2<'_, f32>,
    actions: PyReadonlyArray2<'_, f32>,
    rewards: PyReadonlyArray1<'_, f32>,
    next_observations: PyReadonlyArray2<'_, f32>,
    terminals: PyReadonlyArray1<'_, bool>,
    timeouts: PyReadonlyArray1<'_, bool>,
    observation_names: Vec<String>,
    action_names: Vec<String>,
) -> PyResult<()> {
    let arrays = Arrays {
        observation_dim: observations.shape()[1],
        action_dim: actions.shape()[1],
        observations: observations.as_slice()?.to_vec(),
        actions: actions.as_slice()?.to_vec(),
        rewards: rewards.as_slice()?.to_vec(),
        next_observations: next_observations.as_slice()?.to_vec(),
        terminals: terminals.as_slice()?.to_vec(),
        timeouts: timeouts.as_slice()?.to_vec(),
    };
    let names = Names { observations: observation_names, actions: action_names };
    py.detach(|| write_own(path, arrays, names)).map_err(|error| refused(&error))
}

/// A summary of a dataset, as JSON and as text.
#[pyfunction]
pub fn inspect_dataset(py: Python<'_>, path: PathBuf) -> PyResult<(String, String)> {
    let inspection = py.detach(|| inspect(&[path], None)).map_err(|error| refused(&error))?;
    Ok((json(serde_json::to_string(&inspection))?, inspection.to_string()))
}

/// A task's goal (x and y, meters), its reach, and the index in `qpos` of the x that must reach it.
type Maze = ([f64; 2], f64, usize);

/// A benchmark's tasks: name, dataset and, if that is a maze, what rewards follow from.
#[pyfunction]
pub fn benchmark_tasks(benchmark: &str) -> Vec<(String, String, Option<Maze>)> {
    let tasks = benchmarks::tasks().filter(|task| task.benchmark.name == benchmark);
    let maze = |task: quad_dataset::MazeTask| (task.goal, task.reach, task.measured);
    tasks.map(|task| (task.name, task.dataset, task.maze.map(maze))).collect()
}

/// A run's results and its configuration, each as JSON.
#[pyfunction]
pub fn read_run(py: Python<'_>, folder: PathBuf) -> PyResult<(String, String)> {
    let report = py.detach(|| RunReport::read(&folder)).map_err(|error| {
        PyRuntimeError::new_err(format!("{}\nhint: {}", one_line(&error), error.hint()))
    })?;
    let config = serde_json::to_string(&report.config);
    Ok((json(serde_json::to_string(&report))?, json(config)?))
}

fn json(text: serde_json::Result<String>) -> PyResult<String> {
    text.map_err(|error| PyRuntimeError::new_err(error.to_string()))
}
