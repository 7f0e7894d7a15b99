//! What the learner and an algorithm know of each other: hyper-parameters, an update, a policy to publish, a state as named
//! tensors, and a table of metrics; and what algorithms share to check and to measure.

use candle_core::{Device, Result, Tensor};
use quad_dataset::Batch;
use quad_policy::{Description, PolicyError, Precision, Tensors};
use serde::de::DeserializeOwned;

/// What is known of an algorithm before it runs.
#[derive(Clone, Copy, Debug)]
pub struct Definition {
    /// Its name on the command line and in files.
    pub name: &'static str,
    /// What each update measures, in the order of the values that it gives.
    pub metrics: &'static [Metric],
    /// The file of its values for each task, `presets/NAME.toml`.
    pub settings: &'static str,
    /// The hyper-parameter that tells its variants apart in run names and tables, if it has any.
    pub variant: Option<&'static str>,
    /// Reads its hyper-parameters, the `[agent]` table of a preset, and checks them.
    pub read: fn(&toml::Table) -> std::result::Result<Box<dyn Hyperparameters>, AgentError>,
}

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

/// The hyper-parameters of one algorithm.
pub trait Hyperparameters: Send + Sync {
    /// What tells variants of the algorithm apart, in run names and tables.
    fn variant(&self) -> String;

    /// The figures that matter most, for a line of the log.
    fn summary(&self) -> String;

    /// Whether its policy samples candidates and chooses the best.
    fn samples_candidates(&self) -> bool;

    /// The algorithm at step 0.
    ///
    /// # Errors
    /// Candle fails.
    fn start(&self, setting: &Setting) -> std::result::Result<Box<dyn Algorithm>, AlgorithmError>;
}

/// What an algorithm has to know of a run.
#[derive(Clone, Debug)]
pub struct Setting {
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Numbers in an action.
    pub action_dim: usize,
    /// Transitions per update, B.
    pub batch_size: usize,
    /// Updates of the whole run; learning rates that decay reach 0 there.
    pub total_steps: u64,
    /// Seed of initial weights and noise.
    pub seed: u64,
    /// Precision of forward passes without a gradient.
    pub precision: Precision,
    /// Where the tensors lie.
    pub device: Device,
}

/// An algorithm in the middle of a run.
pub trait Algorithm: Send {
    /// Update number `step`, from 0; its random numbers are a function of the run's seed and this number. Gives the
    /// values of the algorithm's metrics.
    ///
    /// # Errors
    /// Candle fails, for example because the batch does not fit the networks.
    fn update(&mut self, step: u64, batch: &Minibatch) -> Result<Vec<f32>>;

    /// The policy to be evaluated: what kind it is, and its tensors.
    ///
    /// # Errors
    /// Candle fails.
    fn policy(&self) -> Result<(Description, Tensors)>;

    /// Everything that updates change: with the step it decides the future of the run.
    ///
    /// # Errors
    /// Candle fails.
    fn state(&self) -> Result<Tensors>;

    /// Goes on from a state, whose tensors are taken out of `tensors`.
    ///
    /// # Errors
    /// A tensor that is missing or does not fit.
    fn load(&mut self, tensors: &mut Tensors) -> std::result::Result<(), PolicyError>;
}

/// A batch of B transitions as tensors.
#[derive(Clone, Debug)]
pub struct Minibatch {
    /// s, `[B, o]`.
    pub observations: Tensor,
    /// a, `[B, a]`.
    pub actions: Tensor,
    /// r, `[B]`.
    pub rewards: Tensor,
    /// s', `[B, o]`.
    pub next_observations: Tensor,
    /// 0 where the episode terminated, else 1; `[B]`.
    pub masks: Tensor,
}

impl Minibatch {
    /// Copies a batch to a device.
    ///
    /// # Errors
    /// Candle fails.
    pub fn new(batch: &Batch, device: &Device) -> Result<Self> {
        let b = batch.size;
        let rows = |numbers: &[f32]| Tensor::from_slice(numbers, (b, numbers.len() / b), device);
        let column = |numbers: &[f32]| Tensor::from_slice(numbers, b, device);
        Ok(Self {
            observations: rows(&batch.observations)?,
            actions: rows(&batch.actions)?,
            rewards: column(&batch.rewards)?,
            next_observations: rows(&batch.next_observations)?,
            masks: column(&batch.masks)?,
        })
    }
}

/// Why an algorithm cannot start or be saved.
#[derive(Debug, thiserror::Error)]
pub enum AlgorithmError {
    /// The policy or the state does not hold what it should.
    #[error(transparent)]
    Policy(#[from] PolicyError),
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

/// Reads a table of hyper-parameters.
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

/// That a hyper-parameter is above 0 and finite.
pub(super) fn check_positive(field: &'static str, value: f32) -> std::result::Result<(), AgentError> {
    check(field, value, value > 0.0 && value.is_finite(), "above 0")
}

/// That a hyper-parameter is in (0, 1].
pub(super) fn check_rate(field: &'static str, value: f32) -> std::result::Result<(), AgentError> {
    check(field, value, value > 0.0 && value <= 1.0, "in (0, 1]")
}

/// That a number of things is within 1..=`most`.
pub(super) fn check_count(field: &'static str, value: usize, most: usize) -> std::result::Result<(), AgentError> {
    check(field, value, (1..=most).contains(&value), "a whole number from 1 on, of reasonable size")
}

/// Tensors `[]` as numbers; from a GPU in one copy, because each copy waits for the GPU.
pub(super) fn numbers(x: &[&Tensor]) -> Result<Vec<f32>> {
    match x.iter().all(|x| x.device().is_cpu()) {
        true => x.iter().map(|x| x.to_scalar()).collect(),
        false => Tensor::stack(x, 0)?.to_vec1(),
    }
}
