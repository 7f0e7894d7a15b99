//! An algorithm at work in a run: counts its updates, hands over its policy, and saves and loads its whole state.

use crate::algorithm::{Algorithm, AlgorithmError, Definition, Metric};
use crate::context::Context;
#[cfg(test)]
use crate::parts::Parts;
use crate::pool::run_awake;
use candle_core::Device;
use quad_policy::{Header, PolicyError, Scaling, read_header, read_tensors, write_tensors};
use serde::{Deserialize, Serialize};

/// Key of the counters in the metadata of a saved state.
const COUNTERS: &str = "state";

/// An algorithm, where it runs, and how far it is.
pub struct Agent {
    definition: Definition,
    algorithm: Box<dyn Algorithm>,
    device: Device,
    /// The maps between the data's units and the algorithm's, unless they are the same.
    scaling: Option<Scaling>,
    /// Updates done.
    step: u64,
}

/// What a saved state holds beside its tensors.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Counters {
    algorithm: String,
    step: u64,
}

/// A saved state that cannot be gone on from.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// Of another algorithm.
    #[error("the state is of the algorithm {found}, this run is of {expected}")]
    Algorithm {
        /// The state's.
        found: String,
        /// The run's.
        expected: &'static str,
    },
    /// Its tensors are not the algorithm's.
    #[error(transparent)]
    Policy(#[from] PolicyError),
}

impl Agent {
    /// At step 0, with the hyper-parameters of this table.
    ///
    /// # Errors
    /// They cannot be used, or candle fails.
    pub fn new(definition: Definition, table: &toml::Table, context: Context) -> Result<Self, AlgorithmError> {
        let device = context.device.clone();
        let scaling = Some(context.transitions.scaling().clone()).filter(|scaling| *scaling != Scaling::default());
        Ok(Self { definition, algorithm: (definition.start)(table, context)?, device, scaling, step: 0 })
    }

    /// The algorithm's state.
    #[cfg(test)]
    pub(crate) fn parts(&mut self) -> Parts<'_> {
        self.algorithm.parts()
    }

    /// How many items updates draw from.
    pub fn items(&self) -> usize {
        self.algorithm.items()
    }

    /// What an update measures.
    pub fn metrics(&self) -> &'static [Metric] {
        self.definition.metrics
    }

    /// Updates done.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// One update on the items of these numbers. Gives the values of the metrics, in their order.
    ///
    /// # Errors
    /// Candle fails.
    pub fn update(&mut self, items: &[u32]) -> Result<Vec<f32>, AlgorithmError> {
        let (algorithm, step) = (&mut self.algorithm, self.step);
        let values = match self.device.is_cpu() {
            true => run_awake(|| algorithm.update(step, items))?,
            false => algorithm.update(step, items)?,
        };
        self.step += 1;
        Ok(values)
    }

    /// The file of the policy as it is now, which says where it is from.
    ///
    /// # Errors
    /// A weight that is not finite.
    pub fn policy(&self, origin: impl Serialize) -> Result<Vec<u8>, AlgorithmError> {
        let (policy, tensors) = self.algorithm.policy()?;
        Ok(Header { policy, scaling: self.scaling.clone(), origin }.to_safetensors(&tensors)?)
    }

    /// Everything that decides the future of the run, as one safetensors file: the same bytes for the same state.
    ///
    /// # Errors
    /// A number that is not finite: a state with no future.
    pub fn save(&mut self) -> Result<Vec<u8>, AlgorithmError> {
        let counters = Counters { algorithm: self.definition.name.to_owned(), step: self.step };
        Ok(write_tensors(&self.algorithm.parts().save()?, COUNTERS, &counters)?)
    }

    /// Goes on from a saved state, bit for bit, if the run's configuration is the same.
    ///
    /// # Errors
    /// A file that is not the whole state of this algorithm; the agent is not to be used then.
    pub fn load(&mut self, bytes: &[u8]) -> Result<(), StateError> {
        let counters: Counters = read_header(bytes, COUNTERS)?;
        if counters.algorithm != self.definition.name {
            return Err(StateError::Algorithm { found: counters.algorithm, expected: self.definition.name });
        }
        let mut tensors = read_tensors(bytes)?;
        self.algorithm.parts().load(&mut tensors)?;
        if let Some(name) = tensors.into_keys().next() {
            return Err(PolicyError::Unexpected(name).into());
        }
        self.step = counters.step;
        Ok(())
    }
}
