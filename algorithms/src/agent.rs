//! An agent in training, which counts an algorithm's updates, publishes its policy, saves and loads
//! its state.

use crate::algorithm::Algorithm;
use crate::batch::Batch;
use crate::context::Context;
use crate::definition::{Definition, Metric};
use crate::error::AlgorithmError;
use crate::examples::{Columns, Examples};
use crate::losses::Measured;
use crate::pool::run_awake;
use crate::replay::Inputs;
use candle_core::Device;
use quad_dataset::{Names, Transitions, Window};
use quad_nn::Scaling;
use quad_policy::{Chunk, Header, PolicyError, read_header, read_tensors, write_tensors};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use toml::Table;

/// Key of the counters in the metadata of a saved state.
const COUNTERS: &str = "state";

/// An algorithm in training.
pub struct Agent {
    definition: Definition,
    pub(super) algorithm: Box<dyn Algorithm>,
    device: Device,
    columns: Columns,
    window: Window,
    /// The chunk that the policy knows as one action.
    chunk: Chunk,
    /// The maps between the data's units and the algorithm's, unless they are the same.
    scaling: Option<Scaling>,
    /// The dataset's names of observations and actions.
    names: Names,
    step: u64,
}

/// The metadata of a saved state.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Counters {
    algorithm: String,
    step: u64,
}

/// A saved state from which training cannot continue.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each variant is.
pub enum StateError {
    #[error("the state is of the algorithm {0}, this run is of {1}")]
    Algorithm(String, &'static str),
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

impl Agent {
    /// Makes an agent at step 0 with the hyper-parameters of an `[agent]` table.
    ///
    /// # Errors
    /// The hyper-parameters or the data cannot be used.
    pub fn new(
        definition: Definition,
        table: &Table,
        context: Context,
    ) -> Result<Self, AlgorithmError> {
        let device = context.device.clone();
        let scaling = Some(context.transitions.scaling().clone());
        let scaling = scaling.filter(|scaling| *scaling != Scaling::default());
        let names = context.transitions.names().clone();
        let (chunk, window, start) = definition.read(table)?;
        let columns = match start.columns {
            Columns::Returns(_) if context.online_steps == 0 => Columns::Plain,
            columns => columns,
        };
        let algorithm = (start.new)(Context { window, ..context })?;
        // Each thread has its own queue on a GPU: what this one made must be there for the next.
        device.synchronize()?;
        Ok(Self { definition, algorithm, device, columns, window, chunk, scaling, names, step: 0 })
    }

    /// What it learns from in these transitions.
    ///
    /// # Errors
    /// There is nothing.
    pub fn examples(&self, transitions: Arc<Transitions>) -> Result<Examples, AlgorithmError> {
        Examples::new(transitions, self.columns, self.window)
    }

    /// The algorithm's table of metrics, in the order of what [`Self::update`] returns.
    pub fn metrics(&self) -> &'static [Metric] {
        self.definition.metrics
    }

    /// The first step of each training phase; updates of different phases take different times.
    pub fn phases(&self) -> Vec<u64> {
        self.algorithm.phases()
    }

    /// Updates done, which is the number of the next one.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// Continues as if this number of updates were done, to time those of a later phase.
    pub fn skip_to(&mut self, step: u64) {
        self.step = step;
    }

    /// Performs an update. Returns the metrics in the order of their table; `None` for those that this
    /// update did not measure.
    pub fn update(&mut self, batch: &Batch) -> Result<Vec<Option<f32>>, AlgorithmError> {
        let (algorithm, step) = (&mut self.algorithm, self.step);
        let copies = algorithm.copies_batches();
        let batch = &batch.on(if copies { &Device::Cpu } else { &self.device })?;
        let measured = match self.device.is_cpu() {
            true => run_awake(|| algorithm.update(step, batch))?,
            false => algorithm.update(step, batch)?,
        };
        self.step += 1;
        Ok(self.in_order(&measured).collect())
    }

    /// Computes the losses of the last update on another batch, as [`Self::update`] returns them, but
    /// only the metrics that are measured on held-out episodes. Changes nothing.
    pub fn evaluate(&self, batch: &Batch) -> Result<Vec<Option<f32>>, AlgorithmError> {
        let batch = &batch.on(&self.device)?;
        let measured = self.algorithm.evaluate(self.step.saturating_sub(1), batch)?;
        let values = self.in_order(&measured).zip(self.metrics());
        Ok(values.map(|(value, metric)| value.filter(|_| metric.held_out)).collect())
    }

    fn in_order(&self, measured: &Measured) -> impl Iterator<Item = Option<f32>> {
        let value =
            move |metric: &Metric| Some(measured.iter().find(|(name, _)| *name == metric.name)?.1);
        self.metrics().iter().map(value)
    }

    /// The file of the current policy, with its origin.
    ///
    /// # Errors
    /// A weight is not finite.
    pub fn policy(&self, origin: impl Serialize) -> Result<Vec<u8>, AlgorithmError> {
        let (policy, tensors) = self.algorithm.policy()?;
        let mut header = Header::new(policy, origin);
        header.chunk = self.chunk;
        header.scaling = self.scaling.clone();
        header.observation_names = self.names.observations.clone();
        header.action_names = self.names.actions.clone();
        Ok(header.to_safetensors(&tensors)?)
    }

    /// The state of the run as a safetensors file: the same bytes for the same state.
    ///
    /// # Errors
    /// A number is not finite.
    pub fn save(&mut self) -> Result<Vec<u8>, AlgorithmError> {
        let (algorithm, step) = (self.definition.name.to_owned(), self.step);
        let tensors = self.algorithm.state_dict().save()?;
        let counters = Counters { algorithm, step };
        Ok(write_tensors(&tensors, COUNTERS, &counters)?)
    }

    /// Resumes from a saved state, bit for bit if the run's configuration is the same.
    ///
    /// # Errors
    /// The file is not the whole state of this algorithm; the agent is not to be used then.
    pub fn load(&mut self, bytes: &[u8]) -> Result<(), StateError> {
        let counters: Counters = read_header(bytes, COUNTERS)?;
        let expected = self.definition.name;
        if counters.algorithm != expected {
            return Err(StateError::Algorithm(counters.algorithm, expected));
        }
        let mut tensors = read_tensors(bytes)?;
        self.algorithm.state_dict().load(&mut tensors)?;
        if let Some(name) = tensors.into_keys().next() {
            return Err(PolicyError::Unexpected(name).into());
        }
        self.step = counters.step;
        Ok(())
    }
}
