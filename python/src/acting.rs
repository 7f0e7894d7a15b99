//! Actions for the rows of an array, their seeds, and the choice among candidates.

use std::fmt::Display;
use std::process;
use std::str::FromStr;
use std::sync::{Arc, OnceLock};

use numpy::{PyArray, PyArrayDyn, PyArrayMethods};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use quad_policy::{Choice, EpisodeState, Policy, PolicyError};

use crate::arrays::Rows;
use crate::error::policy_error;

/// Memory of one call of a policy, bytes; more rows are split. An action does not depend on other rows.
const MEMORY: u64 = 256 << 20;

const FORKED: &str = "this process was forked from one in which a policy has acted, and a fork lacks the threads that compute\n\
                      hint: multiprocessing.set_start_method(\"spawn\"), or let policies act only after the fork";

/// Output of a policy.
pub type Array<'py> = Bound<'py, PyArrayDyn<f32>>;

/// The policy's action in each row, `[rows, action_size]`.
pub fn act<'py>(
    py: Python<'py>,
    policy: &dyn Policy,
    rows: &Rows<'_>,
    states: &mut [EpisodeState],
) -> PyResult<Array<'py>> {
    let width = policy.action_dim();
    let mut actions = vec![0.0; rows.count * width];
    compute(py, || {
        let mut left = actions.as_mut_slice();
        for (observations, states) in parts(policy, &rows.values, states) {
            let (now, later) = left.split_at_mut(states.len() * width);
            policy.act(observations, states, now)?;
            left = later;
        }
        Ok(())
    })?;
    rows.array(py, actions, &[width])
}

/// Runs a policy without Python's lock. Fails in a process that was forked after a policy has run:
/// rayon's threads, which a fork does not copy, would never answer.
pub fn compute<T: Send>(
    py: Python<'_>,
    work: impl Send + FnOnce() -> Result<T, PolicyError>,
) -> PyResult<T> {
    static PROCESS: OnceLock<u32> = OnceLock::new();
    if *PROCESS.get_or_init(process::id) != process::id() {
        return Err(PyRuntimeError::new_err(FORKED));
    }
    py.detach(work).map_err(|error| policy_error(&error))
}

/// Splits rows and their states into parts of bounded memory.
pub fn parts<'a>(
    policy: &dyn Policy,
    observations: &'a [f32],
    states: &'a mut [EpisodeState],
) -> impl Iterator<Item = (&'a [f32], &'a mut [EpisodeState])> {
    let rows = (MEMORY / policy.memory(1).max(1)).max(1) as usize;
    observations.chunks(rows * policy.observation_dim()).zip(states.chunks_mut(rows))
}

/// The initial states of the episodes of these seeds.
pub fn begin(policy: &dyn Policy, seeds: &[u64]) -> Vec<EpisodeState> {
    seeds.iter().map(|seed| policy.begin(*seed)).collect()
}

/// The noise of a policy in the first step of these episodes, by name.
pub fn noise<'py>(
    py: Python<'py>,
    policy: &dyn Policy,
    states: &mut [EpisodeState],
) -> PyResult<Bound<'py, PyDict>> {
    let shape = policy.noise();
    let draws = policy.choice().map_or(0, |choice| choice.uniforms());
    let row = match shape.is_empty() {
        true => 0,
        false => shape.iter().product(),
    };
    let (mut normal, mut uniform) = (vec![0.0; states.len() * row], Vec::new());
    for (i, state) in states.iter_mut().enumerate() {
        state.fill_normal(&mut normal[i * row..][..row]);
        // The last f32 below 1 rather than 1 itself.
        uniform.extend((0..draws).map(|_| (state.uniform() as f32).min(1.0_f32.next_down())));
    }
    let inputs = PyDict::new(py);
    let rows = states.len();
    if row > 0 {
        let shape = [&[rows], &shape[..]].concat();
        inputs.set_item("noise", PyArray::from_vec(py, normal).reshape(shape)?)?;
    }
    if draws > 0 {
        inputs.set_item("uniform", PyArray::from_vec(py, uniform).reshape([rows, draws])?)?;
    }
    Ok(inputs)
}

/// A seed for each of n rows: `seed + i`, or those of a sequence, or random ones.
pub fn seeds(seed: Option<&Bound<'_, PyAny>>, n: usize) -> PyResult<Vec<u64>> {
    let Some(seed) = seed else { return Ok((0..n).map(|_| rand::random()).collect()) };
    if let Ok(seed) = seed.extract::<u64>() {
        return Ok((0..n as u64).map(|i| seed.wrapping_add(i)).collect());
    }
    match seed.extract::<Vec<u64>>() {
        Ok(seeds) if seeds.len() == n => Ok(seeds),
        _ => Err(not_seeds(&format!("a sequence of {n} of them, or None"))),
    }
}

pub fn not_seeds(or: &str) -> PyErr {
    PyValueError::new_err(format!("a seed must be an int from 0 to 2**64 - 1, or {or}"))
}

/// The policy with a changed choice.
pub fn choosing(
    policy: &Arc<dyn Policy>,
    candidates: Option<i64>,
    rule: Option<String>,
    aggregate: Option<String>,
    guidance: Option<f32>,
) -> PyResult<Arc<dyn Policy>> {
    if candidates.is_none() && rule.is_none() && aggregate.is_none() && guidance.is_none() {
        return Ok(policy.clone());
    }
    let mut choice = policy.choice().unwrap_or(Choice::best_of(1));
    choice.guidance = guidance.unwrap_or(choice.guidance);
    if let Some(candidates) = candidates {
        let most = Choice::MOST_CANDIDATES;
        let count = u32::try_from(candidates).ok().filter(|n| (1..=most).contains(n));
        let error = format!("candidates is {candidates}, but must be from 1 to {most}");
        choice.candidates = count.ok_or_else(|| PyValueError::new_err(error))?;
    }
    if let Some(rule) = rule {
        choice.rule = parse("rule", &rule)?;
    }
    if let Some(aggregate) = aggregate {
        choice.aggregate = parse("aggregate", &aggregate)?;
    }
    policy.with_choice(choice).map(Arc::from).map_err(|error| policy_error(&error))
}

fn parse<T: FromStr<Err: Display>>(name: &str, text: &str) -> PyResult<T> {
    let error = |expected| PyValueError::new_err(format!("{name} is {text:?}, not {expected}"));
    text.parse().map_err(error)
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
