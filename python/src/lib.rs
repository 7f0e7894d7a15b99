//! The module `quad_rl._quad_rl`: QUAD for Python. `py/quad_rl/_quad_rl.pyi` has its types.

mod acting;
mod arrays;
mod dataset;
mod episodes;
mod evaluate;
mod file;
mod policy;
mod simulation;

use std::error::Error;

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use quad_policy::PolicyError;
use quad_runtime::one_line;

#[pymodule]
mod _quad_rl {
    #[pymodule_export]
    use crate::dataset::{benchmark_tasks, inspect_dataset, read_run, write_dataset};
    #[pymodule_export]
    use crate::episodes::Episodes;
    #[pymodule_export]
    use crate::evaluate::{serve_environment, simulated};
    #[pymodule_export]
    use crate::policy::PyPolicy;
    #[pymodule_export]
    use crate::simulation::PySimulation;
}

/// A ValueError with a hint.
fn with_hint(error: &dyn Error, hint: &str) -> PyErr {
    PyValueError::new_err(format!("{}\nhint: {hint}", one_line(error)))
}

/// A RuntimeError where arithmetic fails, else a ValueError.
fn policy_error(error: &PolicyError) -> PyErr {
    match error {
        PolicyError::Candle(_) | PolicyError::NotANumber(_) => {
            PyRuntimeError::new_err(one_line(error))
        }
        _ => PyValueError::new_err(one_line(error)),
    }
}
