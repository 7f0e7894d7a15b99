//! The training thread: samples a batch, updates the agent, again and again. It never waits for network, disk or
//! metrics: gauges are atomics, rows go into a bounded queue that drops what does not fit, and snapshots are handed
//! over by a send that cannot block.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::time::Instant;

use quad_dataset::{Batch, BatchSampler, Transitions};
use serde::Serialize;
use tracing::debug;

use crate::agent::{AgentError, StepMetrics, Trainee};
use crate::metrics::TrainingMetrics;

/// Gradient steps that a line of `metrics.jsonl` averages over.
pub const STEPS_PER_ROW: u64 = 100;

/// What is to be done.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Gradient steps.
    pub steps: u64,
    /// Gradient steps between two evaluations; 0: none at all.
    pub eval_interval: u64,
}

/// Where the results go.
pub struct Outlets<'a> {
    /// Gauges that the metrics page and the progress display read.
    pub metrics: TrainingMetrics,
    /// Lines for `metrics.jsonl`.
    pub rows: SyncSender<Row>,
    /// Takes a policy to be published or kept; must not block.
    pub snapshot: &'a dyn Fn(TrainedPolicy),
    /// Set by somebody who wants training to end early.
    pub stop: &'a AtomicBool,
}

/// The policy after a gradient step, as it is handed over by training.
#[derive(Debug)]
pub struct TrainedPolicy {
    /// After which step.
    pub step: u64,
    /// A safetensors file.
    pub tensors: Vec<u8>,
    /// Whether it is to be evaluated, or only kept.
    pub evaluate: bool,
}

/// A line of `metrics.jsonl`: means over the gradient steps since the line before.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[allow(missing_docs)] // the fields of `StepMetrics`, see docs/metrics.md
pub struct Row {
    pub step: u64,
    /// Since training began.
    pub seconds: f64,
    pub critic_loss: f32,
    pub bc_loss: f32,
    pub actor_loss: f32,
    pub eta: f32,
    pub lambda_mean: f32,
    pub q_mean: f32,
    pub nu_squared: f32,
    pub critic_gradient_norm: f32,
    pub actor_gradient_norm: f32,
    pub learning_rate: f32,
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
    /// A loss is not a number any more.
    #[error("training diverged: at gradient step {step} the {what} is {value}")]
    Diverged {
        /// The step.
        step: u64,
        /// Which loss.
        what: &'static str,
        /// What it is.
        value: f32,
    },
    /// The update failed.
    #[error("gradient step {step} failed")]
    Update {
        /// The step.
        step: u64,
        /// Why.
        source: AgentError,
    },
}

/// Trains until all steps are done or somebody asks to stop; at the end the last snapshot is handed over in any case.
pub fn train(
    agent: &mut dyn Trainee,
    transitions: &Transitions,
    sampler: &mut BatchSampler,
    plan: Plan,
    outlets: &Outlets<'_>,
) -> Result<Outcome, TrainError> {
    let start = Instant::now();
    let mut batch = Batch::default();
    let mut mean = RowMean::default();
    for step in 1..=plan.steps {
        let begin = Instant::now();
        sampler.next(transitions, &mut batch);
        let metrics = agent.update(&batch).map_err(|source| TrainError::Update { step, source })?;
        check_finite(step, &metrics)?;
        outlets.metrics.observe(&metrics, begin.elapsed());
        mean.add(&metrics);

        let last = step == plan.steps;
        let stopped = !last && outlets.stop.load(Ordering::Relaxed);
        if step % STEPS_PER_ROW == 0 || last || stopped {
            // A full queue means that the disk is slow; the row is for people, training is not to wait for it.
            outlets.rows.try_send(mean.take(step, start.elapsed().as_secs_f64())).ok();
        }
        let due = plan.eval_interval > 0 && (last || step % plan.eval_interval == 0);
        if due || last || stopped {
            debug!(step, "snapshot");
            let tensors = agent.target_safetensors().map_err(|source| TrainError::Update { step, source })?;
            (outlets.snapshot)(TrainedPolicy { step, tensors, evaluate: due });
        }
        if stopped {
            return Ok(Outcome::Stopped { step });
        }
    }
    Ok(Outcome::Completed)
}

fn check_finite(step: u64, metrics: &StepMetrics) -> Result<(), TrainError> {
    let losses = [
        ("critic loss", metrics.critic_loss),
        ("behaviour-cloning loss", metrics.bc_loss),
        ("actor loss", metrics.actor_loss),
    ];
    match losses.into_iter().find(|(_, value)| !value.is_finite()) {
        Some((what, value)) => Err(TrainError::Diverged { step, what, value }),
        None => Ok(()),
    }
}

/// Sums in f64, in the order of `Row`'s fields.
#[derive(Default)]
struct RowMean {
    sums: [f64; 10],
    count: u64,
}

impl RowMean {
    fn add(&mut self, metrics: &StepMetrics) {
        let values = [
            metrics.critic_loss,
            metrics.bc_loss,
            metrics.actor_loss,
            metrics.eta,
            metrics.lambda_mean,
            metrics.q_mean,
            metrics.nu_squared,
            metrics.critic_gradient_norm,
            metrics.actor_gradient_norm,
            metrics.learning_rate,
        ];
        self.count += 1;
        self.sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += f64::from(value));
    }

    fn take(&mut self, step: u64, seconds: f64) -> Row {
        let Self { sums, count } = std::mem::take(self);
        let [
            critic_loss,
            bc_loss,
            actor_loss,
            eta,
            lambda_mean,
            q_mean,
            nu_squared,
            critic_gradient_norm,
            actor_gradient_norm,
            learning_rate,
        ] = sums.map(|sum| (sum / count.max(1) as f64) as f32);
        Row {
            step,
            seconds,
            critic_loss,
            bc_loss,
            actor_loss,
            eta,
            lambda_mean,
            q_mean,
            nu_squared,
            critic_gradient_norm,
            actor_gradient_norm,
            learning_rate,
        }
    }
}
