//! The work of the thread `training`: makes the agent, goes on from a checkpoint, trains.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use anyhow::{Context, anyhow};
use quad_algorithms::{Agent, Context as Learning};
use quad_dataset::{BatchSampler, Transitions};
use quad_protocol::{Origin, Snapshot};
use quad_run::config::{Device, Experiment};
use quad_run::run::Checkpoint;
use quad_runtime::{Beat, hinted};

use super::device;
use super::metrics::TrainingMetrics;
use super::outbox::Outbox;
use super::steps::{Outlets, Plan, TrainError, train};

const DIVERGED: &str = "the same configuration would diverge again: try a smaller agent.critic_learning_rate or \
                        agent.actor_learning_rate, a smaller agent.gradient_clip, or look for outliers with \
                        `learner datasets inspect`; begin anew with --fresh";

const TOO_LARGE: &str = "take smaller networks or fewer critics; or train without evaluations (--eval-interval 0) and score the \
                         last snapshot by `evaluator score`";

/// Everything that the thread takes along.
pub(crate) struct Training {
    pub experiment: Experiment,
    pub device: Device,
    pub transitions: Arc<Transitions>,
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

impl Training {
    /// The thread's work. How training ended comes last in the outbox, unless it failed.
    pub fn run(self, beat: &Beat) -> anyhow::Result<()> {
        let mut agent = self.agent()?;
        let experiment = &self.experiment;
        let origin = Origin {
            environment: experiment.environment.clone(),
            seed: experiment.seed,
            step: agent.step(),
            episodes: experiment.episodes,
        };
        if experiment.eval_interval > 0 {
            check_size(agent.policy(&origin)?.len())?;
        }
        let batch_size = experiment.batch_size as usize;
        let mut sampler = BatchSampler::new(agent.items(), batch_size, experiment.seed, agent.step());
        let outlets = Outlets { metrics: &self.metrics, outbox: &self.outbox, origin: &origin, stop: &self.stop, beat };
        let plan = Plan {
            schedule: experiment.schedule(),
            checkpoint_every: self.checkpoint_every,
            seconds_before: self.seconds_before,
        };
        let outcome = train(&mut agent, &mut sampler, plan, &outlets).map_err(|error| {
            let diverged = matches!(error, TrainError::Diverged { .. });
            self.metrics.diverged.set(diverged.into());
            if diverged { hinted(error, DIVERGED) } else { error.into() }
        })?;
        self.outbox.ended(outcome);
        Ok(())
    }

    /// At the step of the checkpoint, or at step 0.
    fn agent(&self) -> anyhow::Result<Agent> {
        let experiment = &self.experiment;
        let context = Learning {
            transitions: self.transitions.clone(),
            batch_size: experiment.batch_size as usize,
            total_steps: experiment.steps,
            seed: experiment.seed,
            precision: experiment.precision,
            device: device::open(self.device)?,
        };
        let mut agent = Agent::new(experiment.definition()?, &experiment.agent, context)?;
        if let Some(Checkpoint { step, state }) = &self.checkpoint {
            let advice = "begin anew with --fresh, or go on with the version of the learner that wrote it";
            agent
                .load(state)
                .map_err(|error| hinted(error, advice))
                .with_context(|| format!("cannot go on from the checkpoint of step {step}"))?;
        }
        Ok(agent)
    }
}

/// That evaluators can be sent a policy's file of so many bytes: they could not at the first evaluation, hours later, either.
fn check_size(bytes: usize) -> anyhow::Result<()> {
    let most = Snapshot::MOST_FILE;
    if bytes <= most {
        return Ok(());
    }
    Err(hinted(anyhow!("the policy's file has {bytes} bytes, and evaluators can be sent at most {most}"), TOO_LARGE))
}
