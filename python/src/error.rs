//! Errors of Rust as Python's exceptions, with their causes and a hint.

use std::error::Error;

use pyo3::PyErr;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use quad_policy::PolicyError;

/// An error and what caused it, in one line.
fn chain(error: &dyn Error) -> String {
    let (mut text, mut source) = (error.to_string(), error.source());
    while let Some(error) = source {
        let reason = error.to_string();
        // Some messages hold their cause already.
        if !text.ends_with(&reason) {
            text = format!("{text}: {reason}");
        }
        source = error.source();
    }
    text
}

/// A ValueError that says what to do.
pub fn with_hint(error: &dyn Error, hint: &str) -> PyErr {
    PyValueError::new_err(format!("{}\nhint: {hint}", chain(error)))
}

/// RuntimeError where arithmetic fails, ValueError for what was asked for.
pub fn of_policy(error: &PolicyError) -> PyErr {
    match error {
        PolicyError::Candle(_) | PolicyError::NotANumber(_) => {
            PyRuntimeError::new_err(chain(error))
        }
        _ => PyValueError::new_err(chain(error)),
    }
}
