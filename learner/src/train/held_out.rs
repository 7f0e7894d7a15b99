//! Metrics on episodes that are kept out of training.

use std::sync::Arc;

use quad_algorithms::{Agent, AlgorithmError, Batch, Examples};
use quad_dataset::{BatchSampler, Transitions};
use quad_run::config::Experiment;
use tracing::{info, warn};

use super::results::{Means, STEPS_PER_ROW, held_out_name};

/// Number of batches, the same for all measurements.
const BATCHES: usize = 4;
/// Most measurements in a run, except that of the last step.
const MEASUREMENTS: u64 = 100;

/// Batches of the held-out episodes.
pub(crate) struct HeldOut {
    batches: Vec<Batch>,
    /// Steps between two measurements.
    every: u64,
    has_warned: bool,
}

impl HeldOut {
    /// `None` if the algorithm cannot be measured on these transitions, or has no metric that can.
    pub fn new(experiment: &Experiment, held_out: Transitions, agent: &Agent) -> Option<Self> {
        if !agent.metrics().iter().any(|metric| metric.held_out) {
            info!(
                "nothing is measured on held-out episodes: {} has no metric that is",
                experiment.algorithm
            );
            return None;
        }
        let size = (experiment.batch_size as usize).min(held_out.len());
        let examples = agent.examples(Arc::new(held_out));
        let held_out = examples.and_then(|examples| {
            Self::draw(&examples, size, experiment.seed, experiment.total_steps())
        });
        let held_out = held_out.map_err(anyhow::Error::from);
        held_out
            .inspect_err(|error| info!("nothing is measured on held-out episodes: {error:#}"))
            .ok()
    }

    /// Draws the batches by the seed, for a run of this many steps.
    pub(super) fn draw(
        examples: &Examples,
        batch_size: usize,
        seed: u64,
        steps: u64,
    ) -> Result<Self, AlgorithmError> {
        let mut sampler = BatchSampler::new(examples.len(), batch_size, seed, 0);
        let batches = (0..BATCHES).map(|_| examples.batch(sampler.next_indices()));
        let every = steps.div_ceil(MEASUREMENTS).next_multiple_of(STEPS_PER_ROW);
        Ok(Self { batches: batches.collect::<Result<_, _>>()?, every, has_warned: false })
    }

    /// True if the row of this step has measurements.
    pub fn is_due(&self, step: u64, is_last: bool) -> bool {
        is_last || step.is_multiple_of(self.every)
    }

    /// Means over the batches, in the order of the agent's metrics. Leaves out those that are not
    /// finite, and warns of the first.
    pub fn measure(&mut self, agent: &Agent) -> Result<Vec<Option<f32>>, AlgorithmError> {
        let mut means = Means::new(agent.metrics().len());
        for batch in &self.batches {
            means.add(&agent.evaluate(batch)?);
        }
        let mut values = means.take();
        for (metric, value) in agent.metrics().iter().zip(&mut values) {
            let Some(number) = value.take_if(|number| !number.is_finite()) else { continue };
            if !self.has_warned {
                warn!(
                    "at gradient step {} {} is {number} and left out: a number of the held-out episodes is too large for \
                     32 bits, which the policy does not learn from. `learner datasets inspect` looks for outliers",
                    agent.step(),
                    held_out_name(metric),
                );
                self.has_warned = true;
            }
        }
        Ok(values)
    }
}
