//! The loop of gradient steps: samples a batch, updates the agent, again and again.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use quad_algorithms::{Agent, AlgorithmError, Metric};
use quad_dataset::BatchSampler;
use quad_policy::{NetworkError, PolicyError};
use quad_protocol::Origin;
use quad_run::config::Schedule;
use quad_run::folder::Checkpoint;
use quad_runtime::Heartbeat;
use tracing::debug;

use super::held_out::HeldOut;
use super::metrics::TrainingMetrics;
use super::outbox::Outbox;
use super::results::{Means, Outcome, Row, TrainedPolicy, measured};

/// Gradient steps that a line of `metrics.jsonl` averages over.
pub(super) const STEPS_PER_ROW: u64 = 100;
/// Least time of training that is spent between two checkpoints for each second that one takes:
/// saving costs at most 1 %.
const TRAINING_PER_SAVING: u32 = 100;

/// What is to be done.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plan {
    /// How many gradient steps, and which are evaluated.
    pub schedule: Schedule,
    /// Least time between two checkpoints.
    pub checkpoint_every: Duration,
    /// Seconds of training in earlier incarnations of the run.
    pub seconds_before: f64,
}

/// Where the results go, and who ends the loop early.
pub(crate) struct Outlets<'a> {
    /// Gauges that the metrics page and the progress display read.
    pub metrics: &'a TrainingMetrics,
    /// Takes rows, snapshots and checkpoints.
    pub outbox: &'a Outbox,
    /// Where snapshots say that they are from; the step is set for each.
    pub origin: &'a Origin,
    /// Set by the main loop to end training early.
    pub stop: &'a AtomicBool,
    /// Told after every step.
    pub beat: &'a Heartbeat,
}

/// Why training cannot continue.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TrainError {
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
            AlgorithmError::Policy(error @ PolicyError::Network(NetworkError::NotFinite(_))) => {
                Self::Diverged { step, what: error.to_string() }
            }
            source => Self::Update { step, source },
        }
    }
}

/// Trains until all steps are done or it is told to stop. Either way a checkpoint of the last step
/// is handed over.
pub(crate) fn train(
    agent: &mut Agent,
    sampler: &mut BatchSampler,
    mut held_out: Option<&mut HeldOut>,
    plan: Plan,
    outlets: &Outlets<'_>,
) -> Result<Outcome, TrainError> {
    let start = Instant::now();
    let mut means = Means::new(agent.metrics().len());
    let mut next_checkpoint = start + plan.checkpoint_every;
    while agent.step() < plan.schedule.steps {
        let begin = Instant::now();
        let step = agent.step() + 1;
        let values =
            agent.update(sampler.next_items()).map_err(|source| TrainError::at(step, source))?;
        check_finite(step, agent.metrics(), &values)?;
        let updated = Instant::now();
        outlets.beat.alive();
        outlets.metrics.observe(&values, updated - begin);
        means.add(&values);

        let last = step == plan.schedule.steps;
        let stopped = !last && outlets.stop.load(Ordering::Relaxed);
        if step.is_multiple_of(STEPS_PER_ROW) || last || stopped {
            let seconds = plan.seconds_before + start.elapsed().as_secs_f64();
            let mut row = Row {
                step,
                seconds,
                metrics: agent.metrics(),
                values: means.take(),
                held_out: Vec::new(),
            };
            if let Some(held_out) =
                held_out.as_deref_mut().filter(|held_out| held_out.is_due(step, last))
            {
                let values = agent.save().and_then(|state| held_out.measure(&state));
                row.held_out = values.map_err(|source| TrainError::at(step, source))?;
                outlets.metrics.observe_held_out(&row.held_out);
            }
            outlets.outbox.row(row);
        }
        hand_over_policy(agent, plan.schedule, outlets)?;
        if last || stopped || updated >= next_checkpoint {
            let took = hand_over_state(agent, outlets)?;
            next_checkpoint =
                Instant::now() + plan.checkpoint_every.max(TRAINING_PER_SAVING * took);
        }
        if stopped {
            return Ok(Outcome::Stopped { step });
        }
    }
    Ok(Outcome::Completed)
}

/// Hands over the policy if it is to be evaluated, or if it is the last.
fn hand_over_policy(
    agent: &mut Agent,
    schedule: Schedule,
    outlets: &Outlets<'_>,
) -> Result<(), TrainError> {
    let (step, begin) = (agent.step(), Instant::now());
    let evaluate = schedule.is_evaluated(step);
    if evaluate || step == schedule.steps {
        debug!(step, "snapshot");
        let file = agent
            .policy(Origin { step, ..outlets.origin.clone() })
            .map_err(|source| TrainError::at(step, source))?;
        outlets.metrics.saving_seconds.inc_by(begin.elapsed().as_secs_f64());
        outlets.outbox.snapshot(TrainedPolicy { step, file, evaluate }, outlets.stop, outlets.beat);
    }
    Ok(())
}

/// Hands over the whole state. Gives the time that it took to copy it, in which nothing was
/// trained.
fn hand_over_state(agent: &mut Agent, outlets: &Outlets<'_>) -> Result<Duration, TrainError> {
    let (step, begin) = (agent.step(), Instant::now());
    let state = agent.save().map_err(|source| TrainError::at(step, source))?;
    let took = begin.elapsed();
    outlets.metrics.saving_seconds.inc_by(took.as_secs_f64());
    outlets.outbox.checkpoint(Checkpoint { step, state });
    Ok(took)
}

fn check_finite(step: u64, metrics: &[Metric], values: &[Option<f32>]) -> Result<(), TrainError> {
    match measured(metrics, values).find(|(_, value)| !value.is_finite()) {
        Some((metric, value)) => {
            Err(TrainError::Diverged { step, what: format!("{} is {value}", metric.name) })
        }
        None => Ok(()),
    }
}
