//! What updates measure on episodes that are kept out of training.

use quad_algorithms::{Agent, AlgorithmError, Metric};
use quad_dataset::{BatchSampler, Transitions};
use quad_run::config::{Device, Experiment};
use tracing::info;

use super::training::algorithm;

/// Batches that are measured at a time, always the same.
const BATCHES: usize = 4;
/// Most measurements in a run.
const MEASUREMENTS: u64 = 100;

/// Whether a metric says something of data that is not learnt from: losses do, and means of values.
pub(crate) fn is_measured(metric: &Metric) -> bool {
    metric.name.ends_with("_loss") || metric.name.ends_with("_mean")
}

/// What such a metric is called when it is of held-out episodes.
pub(crate) fn name(metric: &Metric) -> String {
    format!("held_out_{}", metric.name)
}

/// The algorithm over the held-out episodes. To measure, it takes over the state of the one that trains and updates it with a
/// held-out batch, because an update measures before it changes anything; what it changes then is forgotten.
pub(crate) struct HeldOut {
    agent: Agent,
    batches: Vec<Vec<u32>>,
    /// Steps between two measurements.
    every: u64,
    /// The step from which the next one is due.
    next: u64,
    newest: Vec<f32>,
}

impl HeldOut {
    /// For the algorithm at its beginning; none where it cannot be measured on these transitions: they hold nothing that it
    /// learns from, or its state has numbers for each transition that it trains on.
    pub fn new(experiment: &Experiment, device: Device, held_out: Transitions, training: &mut Agent) -> Option<Self> {
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
        let mut sampler = BatchSampler::new(agent.items(), size, seed, 0);
        let batches = (0..BATCHES).map(|_| sampler.next_items().to_vec()).collect();
        Self { agent, batches, every: steps.div_ceil(MEASUREMENTS), next: 0, newest: Vec::new() }
    }

    /// The metrics of [`is_measured`] in the order of the algorithm's, measured anew if it is time; else as they were. `state`
    /// gives the state of the algorithm that trains.
    ///
    /// # Errors
    /// Candle fails.
    pub fn values(
        &mut self,
        step: u64,
        state: impl FnOnce() -> Result<Vec<u8>, AlgorithmError>,
    ) -> Result<&[f32], AlgorithmError> {
        if step >= self.next {
            self.newest = self.measure(&state()?)?;
            self.next = step + self.every;
        }
        Ok(&self.newest)
    }

    fn measure(&mut self, state: &[u8]) -> Result<Vec<f32>, AlgorithmError> {
        let mut sums = vec![0.0; self.agent.metrics().len()];
        for batch in &self.batches {
            // A state of this run was loaded at the beginning, and all are alike.
            self.agent.load(state).map_err(candle_core::Error::wrap)?;
            let values = self.agent.update(batch)?;
            sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += f64::from(value));
        }
        let of_metrics = self.agent.metrics().iter().zip(sums);
        Ok(of_metrics.filter(|(metric, _)| is_measured(metric)).map(|(_, sum)| (sum / BATCHES as f64) as f32).collect())
    }
}
