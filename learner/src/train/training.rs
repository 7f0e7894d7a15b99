//! The loop of gradient steps: samples a batch, updates the agent, again and again.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use quad_algorithms::{Agent, AlgorithmError, Examples};
use quad_dataset::BatchSampler;
use quad_policy::{NetworkError, PolicyError};
use quad_protocol::Origin;
use quad_run::config::Schedule;
use quad_run::folder::Checkpoint;
use quad_runtime::{Heartbeat, hinted};
use tracing::debug;

use super::held_out::HeldOut;
use super::metrics::TrainingMetrics;
use super::online::{OnlineError, OnlineTraining};
use super::output_queue::{Output, OutputQueue};
use super::results::{Means, Outcome, Row, STEPS_PER_ROW, TrainedPolicy, measured};

/// Least time of training that is spent between two checkpoints for each second that one takes:
/// saving costs at most 1 %.
const TRAINING_PER_SAVING: u32 = 100;

const DIVERGED: &str = "the same configuration would diverge again: try smaller learning rates (`learner presets TASK` prints the \
                        names of all hyper-parameters), or look for outliers with `learner datasets inspect`; begin anew with \
                        --fresh";

#[derive(Debug, thiserror::Error)]
pub(crate) enum TrainError {
    /// A metric or a tensor is not finite.
    #[error("training diverged: at gradient step {step} {what}")]
    Diverged { step: u64, what: String },
    #[error("gradient step {step} failed")]
    Update { step: u64, source: AlgorithmError },
    #[error(transparent)]
    Online(#[from] OnlineError),
}

impl TrainError {
    fn in_step(step: u64) -> impl Fn(AlgorithmError) -> Self {
        move |source| match source {
            AlgorithmError::Policy(error @ PolicyError::Network(NetworkError::NotFinite(_))) => {
                Self::Diverged { step, what: error.to_string() }
            }
            source => Self::Update { step, source },
        }
    }
}

/// The loop of gradient steps and its connections to the other threads.
pub(crate) struct Training {
    pub agent: Agent,
    pub examples: Examples,
    /// Examples of the dataset alone.
    pub sampler: BatchSampler,
    pub online: Option<OnlineTraining>,
    pub held_out: Option<HeldOut>,
    pub schedule: Schedule,
    /// Origin of the snapshots; the step is set for each.
    pub origin: Origin,
    /// Least time between two checkpoints.
    pub checkpoint_every: Duration,
    /// Seconds of training in earlier incarnations of the run.
    pub seconds_before: f64,
    pub metrics: TrainingMetrics,
    pub queue: OutputQueue,
    /// Set by the main loop to end training early.
    pub stop: Arc<AtomicBool>,
}

impl Training {
    /// The work of the thread `training`. The outcome comes last in the queue, unless training
    /// fails.
    pub fn run(mut self, beat: &Heartbeat) -> anyhow::Result<()> {
        match self.train(beat) {
            Ok(outcome) => self.queue.push(Output::Ended(outcome)),
            Err(error @ TrainError::Diverged { .. }) => {
                self.metrics.diverged.set(1);
                return Err(hinted(error, DIVERGED));
            }
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }

    /// Trains until all steps are done or `stop` is set. Either way the queue gets a checkpoint of
    /// the last step.
    pub(super) fn train(&mut self, beat: &Heartbeat) -> Result<Outcome, TrainError> {
        let start = Instant::now();
        let (steps, metrics) = (self.schedule.steps, self.agent.metrics());
        let mut means = Means::new(metrics.len());
        let mut next_checkpoint = start + self.checkpoint_every;
        let first = self.agent.step();
        if first < steps && self.plays_online_with(first) {
            self.save_policy(first, beat)?;
        }
        while self.agent.step() < steps {
            if !self.online(beat)? {
                let (checkpoint, _) = self.checkpoint(self.agent.step())?;
                self.queue.push(Output::Checkpoint(checkpoint));
                return Ok(Outcome::Stopped);
            }
            let begin = Instant::now();
            let step = self.agent.step() + 1;
            let online = self.online.as_mut().filter(|online| online.has_begun(step - 1));
            let batch = match online {
                Some(online) => self.examples.online_batch(online.rows(step)),
                None => self.examples.batch(self.sampler.next_indices()),
            };
            let values = batch.map_err(AlgorithmError::from);
            let values = values
                .and_then(|batch| self.agent.update(&batch))
                .map_err(TrainError::in_step(step))?;
            let infinite = measured(metrics, &values).find(|(_, value)| !value.is_finite());
            if let Some((metric, value)) = infinite {
                let what = format!("{} is {value}", metric.name);
                return Err(TrainError::Diverged { step, what });
            }
            let updated = Instant::now();
            beat.alive();
            self.metrics.observe(&values, updated - begin);
            means.add(&values);

            let is_last = step == steps;
            let stopped = !is_last && self.stop.load(Ordering::Relaxed);
            // Checks the whole state: what has diverged leaves neither a row nor a snapshot.
            let checkpoint = match is_last || stopped || updated >= next_checkpoint {
                true => Some(self.checkpoint(step)?),
                false => None,
            };
            if step.is_multiple_of(STEPS_PER_ROW) || is_last || stopped {
                let seconds = self.seconds_before + start.elapsed().as_secs_f64();
                let (values, held_out) = (means.take(), self.measure_held_out(step, is_last)?);
                let online = self.online.as_ref().filter(|online| online.has_begun(step - 1));
                let online = online.map_or(Vec::new(), OnlineTraining::row);
                let row = Row { step, seconds, metrics, values, held_out, online };
                self.queue.push(Output::Rows(vec![row]));
            }
            if is_last || self.schedule.is_evaluated(step) || self.plays_online_with(step) {
                self.save_policy(step, beat)?;
            }
            if let Some((checkpoint, pause)) = checkpoint {
                self.queue.push(Output::Checkpoint(checkpoint));
                next_checkpoint = Instant::now() + self.checkpoint_every.max(pause);
            }
            if stopped {
                return Ok(Outcome::Stopped);
            }
        }
        Ok(Outcome::Completed)
    }

    /// Absorbs experience until it allows another gradient step. False if training is to stop.
    fn online(&mut self, beat: &Heartbeat) -> Result<bool, TrainError> {
        let step = self.agent.step();
        let Some(online) = self.online.as_mut().filter(|online| online.has_begun(step)) else {
            return Ok(true);
        };
        loop {
            for opening in online.take_openings() {
                self.queue.push(Output::Online(opening));
            }
            if !online.is_due(step) {
                return Ok(true);
            }
            if let Some(episode) = online.awaited() {
                self.queue.push(Output::Waits(episode));
            }
            if !online.absorb_next(&self.stop, beat)? {
                return Ok(false);
            }
        }
    }

    /// True if online episodes are played with the policy after this gradient step.
    fn plays_online_with(&self, step: u64) -> bool {
        self.online.as_ref().is_some_and(|online| online.is_snapshot(step))
    }

    /// Empty if the row of this step has no such metrics.
    fn measure_held_out(
        &mut self,
        step: u64,
        is_last: bool,
    ) -> Result<Vec<Option<f32>>, TrainError> {
        let held_out = self.held_out.as_mut().filter(|held_out| held_out.is_due(step, is_last));
        let Some(held_out) = held_out else { return Ok(Vec::new()) };
        let values = held_out.measure(&self.agent).map_err(TrainError::in_step(step))?;
        self.metrics.observe_held_out(&values);
        Ok(values)
    }

    fn save_policy(&mut self, step: u64, beat: &Heartbeat) -> Result<(), TrainError> {
        let begin = Instant::now();
        debug!(step, "snapshot");
        self.origin.step = step;
        let file = self.agent.policy(self.origin.clone()).map_err(TrainError::in_step(step))?;
        self.metrics.saving_seconds.inc_by(begin.elapsed().as_secs_f64());
        let (evaluate, online) = (self.schedule.is_evaluated(step), self.plays_online_with(step));
        let policy = TrainedPolicy { step, file, evaluate, online };
        self.queue.snapshot(policy, &self.stop, beat);
        Ok(())
    }

    /// Copies the state, in which time nothing is trained. Also returns the least time until the
    /// next copy.
    ///
    /// # Errors
    /// A number of the state is not finite.
    fn checkpoint(&mut self, step: u64) -> Result<(Checkpoint, Duration), TrainError> {
        let begin = Instant::now();
        let state = self.agent.save().map_err(TrainError::in_step(step))?;
        let took = begin.elapsed();
        self.metrics.saving_seconds.inc_by(took.as_secs_f64());
        Ok((Checkpoint { step, state }, TRAINING_PER_SAVING * took))
    }
}
