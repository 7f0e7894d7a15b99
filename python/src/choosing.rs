//! A policy's choice among its candidates, as Python's arguments.

use std::sync::Arc;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use quad_policy::{Choice, Policy};

use crate::error::of_policy;

/// Arguments that change the choice of the file.
#[derive(Default)]
pub struct Changes {
    pub candidates: Option<i64>,
    pub rule: Option<String>,
    pub aggregate: Option<String>,
    pub guidance: Option<f32>,
}

/// The policy with a changed choice.
pub fn choosing(policy: &Arc<dyn Policy>, changes: Changes) -> PyResult<Arc<dyn Policy>> {
    if let Changes { candidates: None, rule: None, aggregate: None, guidance: None } = changes {
        return Ok(policy.clone());
    }
    let mut choice = policy.choice().unwrap_or(Choice::best_of(1));
    choice.guidance = changes.guidance.unwrap_or(choice.guidance);
    if let Some(candidates) = changes.candidates {
        let most = Choice::MOST_CANDIDATES;
        let count = u32::try_from(candidates).ok().filter(|n| (1..=most).contains(n));
        let error = format!("candidates is {candidates}, but must be from 1 to {most}");
        choice.candidates = count.ok_or_else(|| PyValueError::new_err(error))?;
    }
    if let Some(rule) = changes.rule {
        let error = |expected| PyValueError::new_err(format!("rule is {rule:?}, not {expected}"));
        choice.rule = rule.parse().map_err(error)?;
    }
    if let Some(name) = changes.aggregate {
        let error =
            |expected| PyValueError::new_err(format!("aggregate is {name:?}, not {expected}"));
        choice.aggregate = name.parse().map_err(error)?;
    }
    policy.with_choice(choice).map(Arc::from).map_err(|error| of_policy(&error))
}

/// A choice as Python's arguments.
pub fn as_dictionary(py: Python<'_>, choice: Choice) -> PyResult<Bound<'_, PyDict>> {
    let dictionary = PyDict::new(py);
    dictionary.set_item("candidates", choice.candidates)?;
    dictionary.set_item("rule", choice.rule.to_string())?;
    dictionary.set_item("aggregate", choice.aggregate.to_string())?;
    dictionary.set_item("guidance", choice.guidance)?;
    Ok(dictionary)
}
