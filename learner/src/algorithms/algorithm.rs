//! What the learner and an algorithm know of each other: hyper-parameters, a context, an update, a policy to publish, a state
//! as one list of named parts, and a table of metrics.

use std::sync::Arc;

use candle_core::{Device, Result, Tensor};
use quad_dataset::{Batch, Transitions};
use quad_policy::{MlpConfig, PolicyConfig, PolicyError, Precision, Tensors};
use serde::de::DeserializeOwned;

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
    pub start: Start,
}

/// Makes an algorithm of its hyper-parameters.
pub type Start = fn(&toml::Table, Context) -> std::result::Result<Box<dyn Algorithm>, AlgorithmError>;

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

/// What an algorithm has to know of a run.
#[derive(Clone)]
pub struct Context {
    /// What it learns from: transitions, their order in episodes, windows of them.
    pub transitions: Arc<Transitions>,
    /// Items per update, B.
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

impl Context {
    /// Numbers in an observation.
    pub fn observation_dim(&self) -> usize {
        self.transitions.observation_dim()
    }

    /// Numbers in an action.
    pub fn action_dim(&self) -> usize {
        self.transitions.action_dim()
    }

    /// The transitions of these numbers as tensors.
    ///
    /// # Errors
    /// Candle fails.
    pub fn batch(&self, items: &[u32]) -> Result<Minibatch> {
        let mut batch = Batch::default();
        self.transitions.gather(items, &mut batch);
        Minibatch::new(&batch, &self.device)
    }
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

    /// y = r + γ·mask·v for values v of s', `[B]`, as constants.
    ///
    /// # Errors
    /// Candle fails.
    pub fn target(&self, gamma: f32, next: &Tensor) -> Result<Tensor> {
        Ok((&self.rewards + ((next * &self.masks)? * f64::from(gamma))?)?.detach())
    }
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

/// The hyper-parameters of one algorithm, which its `[agent]` table is read into.
pub(super) trait Hyperparameters: DeserializeOwned {
    /// That each is in its range, as far as its type does not say so.
    fn check(&self) -> std::result::Result<(), AgentError>;
}

/// Reads a table of hyper-parameters and checks them.
pub(super) fn read<T: Hyperparameters>(table: &toml::Table) -> std::result::Result<T, AgentError> {
    let config = T::deserialize(table.clone())?;
    config.check()?;
    Ok(config)
}

/// That a network has hidden layers of reasonable widths.
pub(super) fn check_layers(field: &'static str, layers: &MlpConfig) -> std::result::Result<(), AgentError> {
    layers.check(field).map_err(|_| {
        let value = format!("{:?}", layers.hidden);
        AgentError::Range { field, value, range: "a list of the hidden layers' widths, each from 1 to 65535" }
    })
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

/// Tensors `[]` as numbers; from a GPU in one copy, because each copy waits for the GPU.
pub(super) fn numbers(x: &[&Tensor]) -> Result<Vec<f32>> {
    match x.iter().all(|x| x.device().is_cpu()) {
        true => x.iter().map(|x| x.to_scalar()).collect(),
        false => Tensor::stack(x, 0)?.to_vec1(),
    }
}
