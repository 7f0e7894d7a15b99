//! Policy files and their headers.

use pyo3::exceptions::{PyUserWarning, PyValueError};
use pyo3::prelude::*;
use quad_policy::{Header, Policy, PolicyError, Precision, load_policy};
use quad_protocol::Origin;
use serde_json::{Value, json};

use crate::error::with_hint;

pub const HINT: &str = "a policy is a file like RUN/snapshots/step_000020000.safetensors, as `learner train` of this version writes them";

/// Loads a policy from a file, which errors call `name`. Warns if this CPU lacks the precision.
pub fn read(
    py: Python<'_>,
    file: &[u8],
    precision: &str,
    name: &str,
) -> PyResult<(Precision, Box<dyn Policy>, Header<Origin>)> {
    let asked: Precision = precision.parse().map_err(|_| {
        PyValueError::new_err(format!("precision is {precision:?}, not f32 or bf16"))
    })?;
    if !asked.is_available() {
        let message = std::ffi::CString::new(Precision::UNAVAILABLE)?;
        PyErr::warn(py, &py.get_type::<PyUserWarning>(), &message, 2)?;
    }
    let read = py.detach(|| Ok((load_policy(file, asked)?, Header::<Origin>::read(file)?)));
    let (policy, header) = read.map_err(|error: PolicyError| {
        with_hint(&std::io::Error::other(format!("{name} is not a saved policy: {error}")), HINT)
    })?;
    Ok((asked, policy, header))
}

/// The header of a file with the additions of `learner export`, as JSON.
pub fn all_about(header: &Header<Origin>) -> String {
    let Header { chunk, scaling, observation_names, action_names, origin, about, version, .. } =
        header;
    let always = json!({
        "version": version,
        "environment": origin.environment,
        "step": origin.step,
        "observation_names": observation_names,
        "action_names": action_names,
        "chunk": chunk,
        "scaling": scaling,
    });
    let mut fields = about.as_object().cloned().unwrap_or_default();
    fields.extend(always.as_object().cloned().unwrap_or_default());
    Value::from(fields).to_string()
}
