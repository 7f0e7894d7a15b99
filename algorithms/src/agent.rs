//! An algorithm at work in a run: counts its updates, hands over its policy, and saves and loads
//! its whole state.

use crate::algorithm::{Algorithm, AlgorithmError, Measured};
use crate::context::Context;
use crate::definition::{Definition, Metric};
#[cfg(test)]
use crate::parts::Parts;
use crate::pool::run_awake;
use candle_core::Device;
use quad_dataset::Names;
use quad_nn::Scaling;
use quad_policy::{Header, PolicyError, read_header, read_tensors, write_tensors};
use serde::{Deserialize, Serialize};

/// Key of the counters in the metadata of a saved state.
const COUNTERS: &str = "state";

/// An algorithm, where it runs, and how far it is.
pub struct Agent {
    definition: Definition,
    algorithm: Box<dyn Algorithm>,
    device: Device,
    /// Transitions in the dataset.
    transitions: usize,
    /// The maps between the data's units and the algorithm's, unless they are the same.
    scaling: Option<Scaling>,
    /// What the data calls the numbers of its rows.
    names: Names,
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

/// A saved state from which training cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// The state is of another algorithm.
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
    /// Makes an agent at step 0, with the hyper-parameters of this table.
    ///
    /// # Errors
    /// They cannot be used, or candle fails.
    pub fn new(
        definition: Definition,
        table: &toml::Table,
        context: Context,
    ) -> Result<Self, AlgorithmError> {
        let (device, transitions) = (context.device.clone(), context.transitions.len());
        let scaling = Some(context.transitions.scaling().clone())
            .filter(|scaling| *scaling != Scaling::default());
        let names = context.transitions.names().clone();
        let algorithm = (definition.start)(table, context)?;
        // Each thread has a queue of its own on a GPU; the next thread must find what this one has
        // made.
        device.synchronize()?;
        Ok(Self { definition, algorithm, device, transitions, scaling, names, step: 0 })
    }

    /// The algorithm's state.
    #[cfg(test)]
    pub(crate) fn parts(&mut self) -> Parts<'_> {
        self.algorithm.parts()
    }

    /// How many items updates draw from.
    pub fn items(&self) -> usize {
        self.algorithm.items(self.transitions)
    }

    /// What an update measures.
    pub fn metrics(&self) -> &'static [Metric] {
        self.definition.metrics
    }

    /// The steps at which phases begin whose updates take another time than those before.
    pub fn phases(&self) -> Vec<u64> {
        self.algorithm.phases()
    }

    /// Updates done.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// Goes on as if so many updates were done, to measure what those of a later phase take.
    pub fn skip_to(&mut self, step: u64) {
        self.step = step;
    }

    /// One update on the items of these numbers. Gives the values of the metrics, in the order of
    /// their table; none of those that this update did not measure.
    ///
    /// # Errors
    /// Candle fails.
    pub fn update(&mut self, items: &[u32]) -> Result<Vec<Option<f32>>, AlgorithmError> {
        let (algorithm, step) = (&mut self.algorithm, self.step);
        let measured = match self.device.is_cpu() {
            true => run_awake(|| algorithm.update(step, items))?,
            false => algorithm.update(step, items)?,
        };
        self.step += 1;
        Ok(self.in_order(&measured).collect())
    }

    /// What the last update would measure on the items of these numbers if no network moved, as
    /// [`Self::update`] gives it, but only of metrics that are measured on held-out episodes.
    /// Nothing is changed.
    ///
    /// # Errors
    /// Candle fails.
    pub fn evaluate(&self, items: &[u32]) -> Result<Vec<Option<f32>>, AlgorithmError> {
        let measured = self.algorithm.evaluate(self.step.saturating_sub(1), items)?;
        let metrics = self.metrics().iter();
        Ok(self
            .in_order(&measured)
            .zip(metrics)
            .map(|(value, metric)| value.filter(|_| metric.held_out))
            .collect())
    }

    /// Values in the order of the table.
    fn in_order(&self, measured: &Measured) -> impl Iterator<Item = Option<f32>> {
        let value =
            |name| measured.iter().find(|(known, _)| *known == name).map(|(_, value)| *value);
        self.metrics().iter().map(move |metric| value(metric.name))
    }

    /// The file of the policy as it is now, which says where it is from.
    ///
    /// # Errors
    /// A weight that is not finite.
    pub fn policy(&self, origin: impl Serialize) -> Result<Vec<u8>, AlgorithmError> {
        let (policy, tensors) = self.algorithm.policy()?;
        let Names { observations: observation_names, actions: action_names } = self.names.clone();
        let scaling = self.scaling.clone();
        let header =
            Header { scaling, observation_names, action_names, ..Header::new(policy, origin) };
        Ok(header.to_safetensors(&tensors)?)
    }

    /// Everything that decides the future of the run, as one safetensors file: the same bytes for
    /// the same state.
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
            return Err(StateError::Algorithm {
                found: counters.algorithm,
                expected: self.definition.name,
            });
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
