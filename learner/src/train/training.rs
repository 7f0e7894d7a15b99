//! The work of the thread `training`: continues from a checkpoint, trains. The agent is made before
//! the run's folder.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::{Context, anyhow};
use quad_algorithms::{Agent, AlgorithmError, Context as Learning};
use quad_dataset::{BatchSampler, Transitions};
use quad_protocol::{Origin, Snapshot};
use quad_run::config::{Device, Experiment};
use quad_run::folder::Checkpoint;
use quad_runtime::{Heartbeat, Hint, hinted};

use super::device;
use super::held_out::HeldOut;
use super::metrics::TrainingMetrics;
use super::outbox::Outbox;
use super::steps::{Outlets, Plan, TrainError, train};

const DIVERGED: &str = "the same configuration would diverge again: try smaller learning rates (`learner presets TASK` prints the \
                        names of all hyper-parameters), or look for outliers with `learner datasets inspect`; begin anew with \
                        --fresh";

const TOO_LARGE: &str = "take smaller networks or fewer critics; or train without evaluations (--eval-interval 0) and score the \
                         last snapshot by `evaluator score`";

/// Everything that the thread takes along.
pub(crate) struct Training {
    pub experiment: Experiment,
    /// At step 0.
    pub agent: Agent,
    /// What measures it on held-out episodes, if there are any.
    pub held_out: Option<HeldOut>,
    /// Where an earlier incarnation of the run has left off.
    pub checkpoint: Option<Checkpoint>,
    /// Least time between two checkpoints.
    pub checkpoint_every: Duration,
    /// Seconds of training in earlier incarnations.
    pub seconds_before: f64,
    pub metrics: TrainingMetrics,
    pub outbox: Outbox,
    /// Set to end training after its current step.
    pub stop: Arc<AtomicBool>,
}

/// The algorithm of an experiment at step 0. What it cannot learn with, or from, is refused here,
/// before the run has a folder.
///
/// # Errors
/// The algorithm cannot start with its hyper-parameters or these transitions, or evaluators cannot
/// be sent its policy.
pub(crate) fn begin(
    experiment: &Experiment,
    device: Device,
    transitions: Transitions,
) -> anyhow::Result<Agent> {
    let agent = algorithm(experiment, device, transitions, experiment.batch_size as usize)?;
    if experiment.eval_interval > 0 {
        check_size(agent.policy(origin(experiment))?.len())?;
    }
    Ok(agent)
}

/// The algorithm of an experiment over these transitions, with batches of this size.
pub(super) fn algorithm(
    experiment: &Experiment,
    device: Device,
    transitions: Transitions,
    batch_size: usize,
) -> anyhow::Result<Agent> {
    let context = Learning {
        transitions: Arc::new(transitions),
        batch_size,
        total_steps: experiment.steps,
        seed: experiment.seed,
        precision: experiment.precision,
        device: device::open(device)?,
    };
    Agent::new(experiment.definition()?, &experiment.agent, context).hint_of(AlgorithmError::hint)
}

/// Where the snapshots of a run are from; the step is set for each.
pub(super) fn origin(experiment: &Experiment) -> Origin {
    let Experiment { environment, seed, episodes, .. } = experiment;
    Origin { environment: environment.clone(), seed: *seed, step: 0, episodes: *episodes }
}

impl Training {
    /// The thread's work. How training ended comes last in the outbox, unless it failed.
    pub fn run(self, beat: &Heartbeat) -> anyhow::Result<()> {
        let Self { experiment, mut agent, mut held_out, .. } = self;
        if let Some(Checkpoint { step, state }) = &self.checkpoint {
            let advice = "begin anew with --fresh, or continue with the version of the learner that wrote it";
            let loaded = agent.load(state).hint(advice);
            loaded
                .with_context(|| format!("cannot continue from the checkpoint of step {step}"))?;
        }
        let (batch_size, origin) = (experiment.batch_size as usize, origin(&experiment));
        let mut sampler =
            BatchSampler::new(agent.dataset_len(), batch_size, experiment.seed, agent.step());
        let outlets = Outlets {
            metrics: &self.metrics,
            outbox: &self.outbox,
            origin: &origin,
            stop: &self.stop,
            beat,
        };
        let plan = Plan {
            schedule: experiment.schedule(),
            checkpoint_every: self.checkpoint_every,
            seconds_before: self.seconds_before,
        };
        let outcome = train(&mut agent, &mut sampler, held_out.as_mut(), plan, &outlets).map_err(
            |error| {
                let diverged = matches!(error, TrainError::Diverged { .. });
                self.metrics.diverged.set(diverged.into());
                if diverged { hinted(error, DIVERGED) } else { error.into() }
            },
        )?;
        self.outbox.ended(outcome);
        Ok(())
    }
}

/// Checks that evaluators can be sent a policy's file of so many bytes: fails now rather than at
/// the first evaluation.
fn check_size(bytes: usize) -> anyhow::Result<()> {
    let most = Snapshot::MOST_FILE;
    if bytes <= most {
        return Ok(());
    }
    Err(hinted(
        anyhow!("the policy's file has {bytes} bytes, and evaluators can be sent at most {most}"),
        TOO_LARGE,
    ))
}
