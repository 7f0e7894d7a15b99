//! Errors as Python has them.

use std::error::Error;

use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use quad_policy::PolicyError;
use quad_runtime::one_line;

/// A ValueError with a hint.
pub(crate) fn with_hint(error: &dyn Error, hint: &str) -> PyErr {
    PyValueError::new_err(format!("{}\nhint: {hint}", one_line(error)))
}

/// A RuntimeError where arithmetic fails, else a ValueError.
pub(crate) fn policy_error(error: &PolicyError) -> PyErr {
    match error {
        PolicyError::Candle(_) | PolicyError::NotANumber(_) => {
            PyRuntimeError::new_err(one_line(error))
        }
        _ => PyValueError::new_err(one_line(error)),
    }
}
