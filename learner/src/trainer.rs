//! What the training thread does from its start: makes the agent, goes on from a checkpoint, trains.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::SyncSender;
use std::time::Duration;

use anyhow::Context;
use quad_dataset::{BatchSampler, Transitions};
use quad_service::{Beat, hinted};

use crate::agent::Agent;
use crate::algorithms::Setting;
use crate::config::Experiment;
use crate::device::Device;
use crate::keeper::Desk;
use crate::metrics::TrainingMetrics;
use crate::run_dir::Checkpoint;
use crate::train::{Outcome, Outlets, Plan, Row, TrainError, train};

const DIVERGED: &str = "the same configuration would diverge again: try a smaller agent.critic_learning_rate or \
                        agent.actor_learning_rate, a smaller agent.gradient_clip, or look for outliers with \
                        `learner datasets inspect`; begin anew with --fresh";

/// How training ended.
pub type TrainingResult = anyhow::Result<Outcome>;

/// Everything that the thread takes along.
pub(crate) struct Trainer {
    pub experiment: Experiment,
    pub device: Device,
    pub transitions: Transitions,
    pub checkpoint: Option<Checkpoint>,
    pub checkpoint_every: Duration,
    pub seconds_before: f64,
    pub metrics: TrainingMetrics,
    pub rows: SyncSender<Row>,
    pub desk: Desk,
    pub stop: Arc<AtomicBool>,
}

impl Trainer {
    /// The thread's work.
    pub fn run(self, beat: &Beat) -> TrainingResult {
        let experiment = &self.experiment;
        let setting = Setting {
            observation_dim: self.transitions.observation_dim(),
            action_dim: self.transitions.action_dim(),
            batch_size: experiment.batch_size as usize,
            total_steps: experiment.steps,
            seed: experiment.seed,
            precision: experiment.precision,
            device: self.device.open()?,
        };
        let algorithm = experiment.hyperparameters()?.start(&setting)?;
        let mut agent = Agent::new(experiment.definition()?, algorithm, setting.device.clone());
        if let Some(Checkpoint { step, state }) = &self.checkpoint {
            let advice = "begin anew with --fresh, or go on with the version of the learner that wrote it";
            agent
                .load(state)
                .map_err(|error| hinted(error, advice))
                .with_context(|| format!("cannot go on from the checkpoint of step {step}"))?;
        }
        let mut sampler = BatchSampler::new(self.transitions.len(), setting.batch_size, experiment.seed, agent.step());
        let outlets = Outlets {
            metrics: self.metrics.clone(),
            rows: self.rows,
            snapshot: &|policy| self.desk.snapshot(policy, &self.stop),
            checkpoint: &|checkpoint| self.desk.checkpoint(checkpoint),
            stop: &self.stop,
            beat,
        };
        let plan = Plan {
            schedule: experiment.schedule(),
            checkpoint_every: self.checkpoint_every,
            seconds_before: self.seconds_before,
        };
        let outcome = train(&mut agent, &self.transitions, &mut sampler, plan, &outlets).map_err(|error| {
            let diverged = matches!(error, TrainError::Diverged { .. });
            self.metrics.diverged.set(diverged.into());
            if diverged { hinted(error, DIVERGED) } else { error.into() }
        })?;
        if outcome == Outcome::Completed {
            self.desk.trained();
        }
        Ok(outcome)
    }
}
