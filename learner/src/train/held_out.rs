//! Metrics on episodes that are kept out of training.

use quad_algorithms::{Agent, AlgorithmError};
use quad_dataset::{BatchSampler, Transitions};
use quad_run::config::{Device, Experiment};
use tracing::{info, warn};

use super::agent::new_agent;
use super::results::{Means, STEPS_PER_ROW, held_out_name};

/// Number of batches, the same for all measurements.
const BATCHES: usize = 4;
/// Most measurements in a run, except that of the last step.
const MEASUREMENTS: u64 = 100;

/// An agent over the held-out episodes, which loads the state of the one that trains.
pub(crate) struct HeldOut {
    agent: Agent,
    batches: Vec<Vec<u32>>,
    /// Steps between two measurements.
    every: u64,
    has_warned: bool,
}

impl HeldOut {
    /// `None` if the algorithm cannot be measured on these transitions, or has no metric that can.
    pub fn new(
        experiment: &Experiment,
        device: Device,
        held_out: Transitions,
        training: &mut Agent,
    ) -> Option<Self> {
        if !training.metrics().iter().any(|metric| metric.held_out) {
            info!(
                "nothing is measured on held-out episodes: {} has no metric that is",
                experiment.algorithm
            );
            return None;
        }
        let size = (experiment.batch_size as usize).min(held_out.len());
        let loaded = new_agent(experiment, device, held_out, size).and_then(|mut agent| {
            agent.load(&training.save()?)?;
            Ok(agent)
        });
        match loaded {
            Ok(agent) => Some(Self::of(agent, size, experiment.seed, experiment.total_steps())),
            Err(error) => {
                info!("nothing is measured on held-out episodes: {error:#}");
                None
            }
        }
    }

    /// Draws the batches by the seed, for a run of this many steps.
    pub(super) fn of(agent: Agent, batch_size: usize, seed: u64, steps: u64) -> Self {
        let mut sampler = BatchSampler::new(agent.dataset_len(), batch_size, seed, 0);
        let batches = (0..BATCHES).map(|_| sampler.next_indices().to_vec()).collect();
        let every = steps.div_ceil(MEASUREMENTS).next_multiple_of(STEPS_PER_ROW);
        Self { agent, batches, every, has_warned: false }
    }

    /// True if the row of this step has measurements.
    pub fn is_due(&self, step: u64, is_last: bool) -> bool {
        is_last || step.is_multiple_of(self.every)
    }

    /// Evaluates this state of the agent that trains: means over the batches, in the order of its
    /// metrics. Leaves out those that are not finite, and warns of the first.
    pub fn measure(&mut self, state: &[u8]) -> Result<Vec<Option<f32>>, AlgorithmError> {
        // A state of this run was loaded at the beginning, and all are alike.
        self.agent.load(state).map_err(candle_core::Error::wrap)?;
        let mut means = Means::new(self.agent.metrics().len());
        for batch in &self.batches {
            means.add(&self.agent.evaluate(batch)?);
        }
        let mut values = means.take();
        for (metric, value) in self.agent.metrics().iter().zip(&mut values) {
            let Some(number) = value.take_if(|number| !number.is_finite()) else { continue };
            if !self.has_warned {
                warn!(
                    "at gradient step {} {} is {number} and left out: a number of the held-out episodes is too large for \
                     32 bits, which the policy does not learn from. `learner datasets inspect` looks for outliers",
                    self.agent.step(),
                    held_out_name(metric),
                );
                self.has_warned = true;
            }
        }
        Ok(values)
    }
}
