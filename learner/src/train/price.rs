//! Estimates a run's cost from one second of training.

use std::time::{Duration, Instant};

use quad_algorithms::{Agent, AlgorithmError};
use quad_dataset::{BatchSampler, Transitions};
use quad_run::config::{Device, Experiment};
use quad_run::folder::Checkpoint;

use super::training::{begin, origin};

/// How long steps are measured, in all phases together.
const MEASURED: Duration = Duration::from_secs(1);

/// What a run takes.
#[derive(Clone, Copy, Default)]
pub(crate) struct Price {
    /// Seconds of one gradient step.
    pub step: f64,
    /// Bytes of a snapshot.
    pub snapshot: u64,
    /// Bytes of a checkpoint.
    pub checkpoint: u64,
}

impl Price {
    /// Measures the first steps of each phase of a run, on the threads of the pool that calls.
    ///
    /// # Errors
    /// The run could not begin with these transitions, or a step fails.
    pub fn measure(
        experiment: &Experiment,
        device: Device,
        transitions: Transitions,
    ) -> anyhow::Result<Self> {
        let mut agent = begin(experiment, device, transitions)?;
        let mut sampler = BatchSampler::new(
            agent.dataset_len(),
            experiment.batch_size as usize,
            experiment.seed,
            0,
        );
        Ok(Self {
            step: mean_step(&mut agent, &mut sampler, experiment.steps)?,
            snapshot: agent.policy(origin(experiment))?.len() as u64,
            checkpoint: agent.save()?.len() as u64,
        })
    }

    /// Bytes on disk of a whole run: its snapshots, and the checkpoints that are kept.
    pub fn bytes(&self, experiment: &Experiment) -> u64 {
        let snapshots = experiment.schedule().evaluations().max(1);
        snapshots * self.snapshot + Checkpoint::KEPT as u64 * self.checkpoint
    }
}

/// Seconds of a step, in the mean over a run of so many: each phase counts by its share of them.
pub(super) fn mean_step(
    agent: &mut Agent,
    sampler: &mut BatchSampler,
    steps: u64,
) -> Result<f64, AlgorithmError> {
    let mut begins = agent.phases();
    begins.push(steps);
    let phases = Vec::from_iter(
        begins.windows(2).map(|phase| (phase[0], phase[1])).filter(|(begin, end)| begin < end),
    );
    let mut seconds = 0.0;
    for (begin, end) in &phases {
        let mut step = || {
            agent.skip_to(*begin);
            agent.update(sampler.next_items())
        };
        // The first step makes what later ones use again.
        step()?;
        let (start, mut done) = (Instant::now(), 0);
        while done == 0 || start.elapsed() < MEASURED / phases.len() as u32 {
            step()?;
            done += 1;
        }
        seconds += start.elapsed().as_secs_f64() / f64::from(done) * (end - begin) as f64;
    }
    Ok(seconds / steps as f64)
}
