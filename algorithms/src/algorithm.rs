//! What the learner and an algorithm know of each other: hyper-parameters, an update, a policy to publish, a state
//! as one list of named parts, and a table of metrics.

use candle_core::{Result, Tensor};
use quad_policy::{PolicyConfig, PolicyError, Tensors};
use serde::de::DeserializeOwned;

use super::context::Context;
use super::parts::Parts;

/// What is known of an algorithm before it runs.
#[derive(Clone, Copy)]
pub struct Definition {
    /// Its name on the command line and in files.
    pub name: &'static str,
    /// The file of its values for each task, `presets/NAME.toml`.
    pub settings: &'static str,
    /// The hyper-parameter that tells its variants apart in run names and tables, if it has any.
    pub variant: Option<&'static str>,
    /// What each update measures, in the order of the values that it gives.
    pub metrics: &'static [Metric],
    /// Checks its hyper-parameters, the `[agent]` table of a preset.
    pub check: fn(&toml::Table) -> std::result::Result<(), AgentError>,
    /// The algorithm at step 0, of such a table.
    pub start: fn(&toml::Table, Context) -> Started,
}

/// An algorithm, or why it cannot start.
pub type Started = std::result::Result<Box<dyn Algorithm>, AlgorithmError>;

/// A number that an update measures. Gauges, `metrics.jsonl`, the progress display and docs/metrics.md derive from it.
#[derive(Clone, Copy, Debug)]
pub struct Metric {
    /// Its name in `metrics.jsonl`; Prometheus sees `quad_learner_<name>`.
    pub name: &'static str,
    /// What it is, with its equation and, where it has one, its unit.
    pub help: &'static str,
    /// What the progress display calls it; empty where it does not show it.
    pub label: &'static str,
}

/// An algorithm in the middle of a run.
pub trait Algorithm: Send {
    /// How many items updates draw from: the transitions, unless it says otherwise.
    fn items(&self) -> usize;

    /// Update number `step`, from 0, on the items of these numbers; its random numbers are a function of the run's seed and of
    /// `step`. Gives the values of the algorithm's metrics.
    ///
    /// # Errors
    /// Candle fails.
    fn update(&mut self, step: u64, items: &[u32]) -> Result<Vec<f32>>;

    /// The policy to be evaluated: what it is, and its tensors.
    ///
    /// # Errors
    /// Candle fails.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)>;

    /// Everything that updates change, by name: with the step it decides the future of the run. Saving and loading go by it.
    fn parts(&mut self) -> Parts<'_>;
}

/// Why an algorithm cannot start or be saved.
#[derive(Debug, thiserror::Error)]
pub enum AlgorithmError {
    /// The policy or the state does not hold what it should.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// Its hyper-parameters cannot be used.
    #[error(transparent)]
    Agent(#[from] AgentError),
    /// A tensor cannot be computed or moved.
    #[error("candle failed")]
    Candle(#[from] candle_core::Error),
}

/// Hyper-parameters that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// One too many, one too few, or of the wrong type.
    #[error("[agent]: {0}")]
    Parse(#[from] toml::de::Error),
    /// One is outside its range.
    #[error("agent.{field} is {value}, but must be {range}")]
    Range {
        /// Name within the `[agent]` table.
        field: &'static str,
        /// The value that was given.
        value: String,
        /// The values that are allowed.
        range: &'static str,
    },
}

/// Reads a table of hyper-parameters, whose types say their ranges.
pub(super) fn read<T: DeserializeOwned>(table: &toml::Table) -> std::result::Result<T, AgentError> {
    Ok(T::deserialize(table.clone())?)
}

/// That a hyper-parameter is in its range.
pub(super) fn check(
    field: &'static str,
    value: impl ToString,
    holds: bool,
    range: &'static str,
) -> std::result::Result<(), AgentError> {
    if holds { Ok(()) } else { Err(AgentError::Range { field, value: value.to_string(), range }) }
}

/// The smaller of the critics' values, `[K, B]` → `[B]`. (A minimum would drop a NaN; zero times the sum does not.)
pub(super) fn smaller(values: &Tensor) -> Result<Tensor> {
    values.min(0)? + (values.sum(0)? * 0.0)?
}

/// The largest along a dimension, which is no more. (A maximum would drop a NaN; zero times the sum does not.)
pub(super) fn largest(values: &Tensor, dimension: usize) -> Result<Tensor> {
    values.max(dimension)? + (values.sum(dimension)? * 0.0)?
}

/// The numbers of some tensors, one tensor after the other; from a GPU in one copy, because each copy waits for the GPU.
pub(super) fn numbers(x: &[&Tensor]) -> Result<Vec<f32>> {
    let flat: Vec<_> = x.iter().map(|x| x.flatten_all()).collect::<Result<_>>()?;
    match x.iter().all(|x| x.device().is_cpu()) {
        true => flat.iter().map(Tensor::to_vec1).collect::<Result<Vec<_>>>().map(|numbers| numbers.concat()),
        false => Tensor::cat(&flat, 0)?.to_vec1(),
    }
}
