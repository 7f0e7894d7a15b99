//! What the algorithm measures on episodes that are kept out of training.

use quad_algorithms::{Agent, AlgorithmError, Metric};
use quad_dataset::{BatchSampler, Transitions};
use quad_run::config::{Device, Experiment};
use tracing::{info, warn};

use super::results::Means;
use super::steps::STEPS_PER_ROW;
use super::training::algorithm;

/// Batches that are measured at a time, always the same.
const BATCHES: usize = 4;
/// Most measurements in a run, but for the last step's.
const MEASUREMENTS: u64 = 100;

/// The name of a metric of held-out episodes.
pub(super) fn name(metric: &Metric) -> String {
    format!("held_out_{}", metric.name)
}

/// The algorithm over the held-out episodes, which takes over the state of the one that trains.
pub(crate) struct HeldOut {
    agent: Agent,
    batches: Vec<Vec<u32>>,
    /// Steps between two measurements.
    every: u64,
    has_warned: bool,
}

impl HeldOut {
    /// For the algorithm at its beginning; none where it cannot be measured on these transitions:
    /// nothing in its table is, or they hold nothing that it learns from.
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
        let loaded = algorithm(experiment, device, held_out, size).and_then(|mut agent| {
            agent.load(&training.save()?)?;
            Ok(agent)
        });
        let agent = match loaded {
            Ok(agent) => agent,
            Err(error) => {
                info!("nothing is measured on held-out episodes: {error:#}");
                return None;
            }
        };
        Some(Self::of(agent, size, experiment.seed, experiment.steps))
    }

    /// By batches of this size, which the seed draws, in a run of so many steps.
    pub(super) fn of(agent: Agent, size: usize, seed: u64, steps: u64) -> Self {
        let mut sampler = BatchSampler::new(agent.dataset_len(), size, seed, 0);
        let batches = (0..BATCHES).map(|_| sampler.next_items().to_vec()).collect();
        Self {
            agent,
            batches,
            every: steps.div_ceil(MEASUREMENTS).next_multiple_of(STEPS_PER_ROW),
            has_warned: false,
        }
    }

    /// Whether the row of this step has measurements, be it the run's last or not.
    pub fn is_due(&self, step: u64, is_last: bool) -> bool {
        is_last || step.is_multiple_of(self.every)
    }

    /// Measures with this state of the algorithm that trains: means over the batches, in the order
    /// of its metrics. Leaves out what is not finite, and warns of the first.
    ///
    /// # Errors
    /// Candle fails.
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
                    name(metric),
                );
                self.has_warned = true;
            }
        }
        Ok(values)
    }
}
