//! The training thread: samples a batch, updates the agent, again and again. It never waits for network, disk or
//! metrics: gauges are atomics, rows go into a bounded queue that drops what does not fit, and snapshots and checkpoints
//! are left for another thread to keep.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use quad_dataset::{Batch, BatchSampler, Transitions};
use quad_policy::PolicyError;
use quad_service::Beat;
use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};
use tracing::debug;

use crate::agent::{Agent, PolicyFile};
use crate::algorithms::{AlgorithmError, Metric};
use crate::config::Schedule;
use crate::metrics::TrainingMetrics;
use crate::run_dir::Checkpoint;

/// Gradient steps that a line of `metrics.jsonl` averages over.
pub const STEPS_PER_ROW: u64 = 100;
/// Least time of training that is spent between two checkpoints for each second that one takes: saving costs at most 1 %.
const TRAINING_PER_SAVING: u32 = 100;

/// What is to be done.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// How many gradient steps, and which are evaluated.
    pub schedule: Schedule,
    /// Least time between two checkpoints.
    pub checkpoint_every: Duration,
    /// Seconds of training in earlier lives of the run.
    pub seconds_before: f64,
}

/// Where the results go.
pub struct Outlets<'a> {
    /// Gauges that the metrics page and the progress display read.
    pub metrics: TrainingMetrics,
    /// Lines for `metrics.jsonl`.
    pub rows: SyncSender<Row>,
    /// Takes a policy to be published or kept; must not block.
    pub snapshot: &'a dyn Fn(TrainedPolicy),
    /// Takes a state to go on from; must not block.
    pub checkpoint: &'a dyn Fn(Checkpoint),
    /// Set by somebody who wants training to end early.
    pub stop: &'a AtomicBool,
    /// Told after every step.
    pub beat: &'a Beat,
}

/// The policy after a gradient step, as it is handed over by training.
#[derive(Debug)]
pub struct TrainedPolicy {
    /// After which step.
    pub step: u64,
    /// What it is, and its weights.
    pub policy: PolicyFile,
    /// Whether it is to be evaluated, or only kept.
    pub evaluate: bool,
}

/// A line of `metrics.jsonl`: means over the gradient steps since the line before.
#[derive(Clone, Debug)]
pub struct Row {
    /// Gradient steps done.
    pub step: u64,
    /// Since training began.
    pub seconds: f64,
    /// What was measured.
    pub metrics: &'static [Metric],
    /// The means, in the order of `metrics`.
    pub values: Vec<f32>,
}

impl Serialize for Row {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(2 + self.values.len()))?;
        map.serialize_entry("step", &self.step)?;
        map.serialize_entry("seconds", &self.seconds)?;
        for (metric, value) in self.metrics.iter().zip(&self.values) {
            map.serialize_entry(metric.name, value)?;
        }
        map.end()
    }
}

/// How training ended well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// All steps are done.
    Completed,
    /// Somebody asked to stop after this many.
    Stopped {
        /// Gradient steps done.
        step: u64,
    },
}

/// Why training cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// Something is not a number any more.
    #[error("training diverged: at gradient step {step} {what}")]
    Diverged {
        /// The step.
        step: u64,
        /// The metric and its value, or the tensor.
        what: String,
    },
    /// The update failed.
    #[error("gradient step {step} failed")]
    Update {
        /// The step.
        step: u64,
        /// Why.
        source: AlgorithmError,
    },
}

impl TrainError {
    fn at(step: u64, source: AlgorithmError) -> Self {
        match source {
            AlgorithmError::Policy(error @ PolicyError::NotFinite(_)) => {
                Self::Diverged { step, what: error.to_string() }
            }
            source => Self::Update { step, source },
        }
    }
}

/// Trains until all steps are done or somebody asks to stop. Either way a checkpoint of the last step is handed over.
pub fn train(
    agent: &mut Agent,
    transitions: &Transitions,
    sampler: &mut BatchSampler,
    plan: Plan,
    outlets: &Outlets<'_>,
) -> Result<Outcome, TrainError> {
    let start = Instant::now();
    let mut batch = Batch::default();
    let mut mean = RowMean::new(agent.metrics());
    let mut next_checkpoint = start + plan.checkpoint_every;
    while agent.step() < plan.schedule.steps {
        let begin = Instant::now();
        let step = agent.step() + 1;
        sampler.next(transitions, &mut batch);
        let values = agent.update(&batch).map_err(|source| TrainError::at(step, source))?;
        check_finite(step, agent.metrics(), &values)?;
        let updated = Instant::now();
        outlets.beat.alive();
        outlets.metrics.observe(&values, updated - begin);
        mean.add(&values);

        let last = step == plan.schedule.steps;
        let stopped = !last && outlets.stop.load(Ordering::Relaxed);
        if step.is_multiple_of(STEPS_PER_ROW) || last || stopped {
            // A full queue means that the disk is slow; the row is for people, training is not to wait for it.
            let seconds = plan.seconds_before + start.elapsed().as_secs_f64();
            outlets.rows.try_send(mean.take(step, seconds)).ok();
        }
        let evaluate = plan.schedule.is_evaluated(step);
        if evaluate || last {
            debug!(step, "snapshot");
            let policy = agent.policy().map_err(|source| TrainError::at(step, source))?;
            (outlets.snapshot)(TrainedPolicy { step, policy, evaluate });
        }
        if last || stopped || updated >= next_checkpoint {
            let state = agent.save().map_err(|source| TrainError::at(step, source))?;
            (outlets.checkpoint)(Checkpoint { step, state });
            next_checkpoint = Instant::now() + plan.checkpoint_every.max(TRAINING_PER_SAVING * updated.elapsed());
        }
        outlets.metrics.saving_seconds.inc_by(updated.elapsed().as_secs_f64());
        if stopped {
            return Ok(Outcome::Stopped { step });
        }
    }
    Ok(Outcome::Completed)
}

fn check_finite(step: u64, metrics: &[Metric], values: &[f32]) -> Result<(), TrainError> {
    match metrics.iter().zip(values).find(|(_, value)| !value.is_finite()) {
        Some((metric, value)) => Err(TrainError::Diverged { step, what: format!("{} is {value}", metric.name) }),
        None => Ok(()),
    }
}

/// Sums in f64.
struct RowMean {
    metrics: &'static [Metric],
    sums: Vec<f64>,
    count: u64,
}

impl RowMean {
    fn new(metrics: &'static [Metric]) -> Self {
        Self { metrics, sums: vec![0.0; metrics.len()], count: 0 }
    }

    fn add(&mut self, values: &[f32]) {
        self.count += 1;
        self.sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += f64::from(*value));
    }

    fn take(&mut self, step: u64, seconds: f64) -> Row {
        let metrics = self.metrics;
        let Self { sums, count, .. } = std::mem::replace(self, Self::new(metrics));
        let values = sums.iter().map(|sum| (sum / count.max(1) as f64) as f32).collect();
        Row { step, seconds, metrics, values }
    }
}
