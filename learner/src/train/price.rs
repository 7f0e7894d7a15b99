//! What a run costs, foretold by a second's measurement.

use std::sync::Arc;
use std::time::{Duration, Instant};

use quad_algorithms::{Agent, Context};
use quad_dataset::{BatchSampler, Transitions};
use quad_protocol::Origin;
use quad_run::config::{Device, Experiment};
use quad_run::run::Checkpoint;

use super::device;

/// How long steps are measured.
const MEASURED: Duration = Duration::from_secs(1);

/// What a run takes.
#[derive(Clone, Copy)]
pub(crate) struct Price {
    /// Seconds of one gradient step.
    pub step: f64,
    /// Bytes of a snapshot.
    pub snapshot: u64,
    /// Bytes of a checkpoint.
    pub checkpoint: u64,
}

impl Price {
    /// Measures the first steps of a run, on the threads of the pool that calls.
    ///
    /// # Errors
    /// The run could not begin with these transitions, or a step fails.
    pub fn measure(experiment: &Experiment, device: Device, transitions: Transitions) -> anyhow::Result<Self> {
        let batch_size = experiment.batch_size as usize;
        let context = Context {
            transitions: Arc::new(transitions),
            batch_size,
            total_steps: experiment.steps,
            seed: experiment.seed,
            precision: experiment.precision,
            device: device::open(device)?,
        };
        let mut agent = Agent::new(experiment.definition()?, &experiment.agent, context)?;
        let mut sampler = BatchSampler::new(agent.items(), batch_size, experiment.seed, 0);
        let origin = Origin {
            environment: experiment.environment.clone(),
            seed: experiment.seed,
            step: 0,
            episodes: experiment.episodes,
        };
        // The first step makes what later ones use again.
        agent.update(sampler.next_items())?;
        let (begin, mut steps) = (Instant::now(), 0);
        while begin.elapsed() < MEASURED {
            agent.update(sampler.next_items())?;
            steps += 1;
        }
        Ok(Self {
            step: begin.elapsed().as_secs_f64() / f64::from(steps),
            snapshot: agent.policy(&origin)?.len() as u64,
            checkpoint: agent.save()?.len() as u64,
        })
    }

    /// Bytes on disk of a whole run: its snapshots, and the checkpoints that are kept.
    pub fn bytes(&self, experiment: &Experiment) -> u64 {
        let snapshots = experiment.schedule().evaluated_steps().count().max(1) as u64;
        snapshots * self.snapshot + Checkpoint::KEPT as u64 * self.checkpoint
    }
}
