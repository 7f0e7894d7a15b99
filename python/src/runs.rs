//! What `quad_rl.runs` takes from the crate that reads run folders.

use std::path::PathBuf;

use pyo3::exceptions::PyRuntimeError;
use pyo3::prelude::*;
use quad_run::results::RunReport;
use quad_run::run::RunDirError;

/// A run's results and its configuration, each as JSON.
#[pyfunction]
pub fn read_run(py: Python<'_>, folder: PathBuf) -> PyResult<(String, String)> {
    let read = || {
        let report = RunReport::read(&folder)?;
        anyhow::Ok((serde_json::to_string(&report)?, serde_json::to_string(&report.config)?))
    };
    py.detach(read).map_err(|error| {
        let hint = error.downcast_ref().map(RunDirError::hint);
        PyRuntimeError::new_err(format!(
            "{error:#}{}",
            hint.map(|hint| format!("\nhint: {hint}")).unwrap_or_default()
        ))
    })
}
