//! Run folders, for `quad_rl.runs`.

use std::path::PathBuf;

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use quad_run::results::RunReport;
use quad_runtime::one_line;

/// A run's results and its configuration, each as JSON.
#[pyfunction]
pub fn read_run(py: Python<'_>, folder: PathBuf) -> PyResult<(String, String)> {
    let report = py.detach(|| RunReport::read(&folder)).map_err(|error| {
        PyRuntimeError::new_err(format!("{}\nhint: {}", one_line(&error), error.hint()))
    })?;
    let json = (serde_json::to_string(&report), serde_json::to_string(&report.config));
    match json {
        (Ok(report), Ok(config)) => Ok((report, config)),
        (Err(error), _) | (_, Err(error)) => Err(PyRuntimeError::new_err(error.to_string())),
    }
}
