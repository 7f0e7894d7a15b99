//! Estimates a run's cost from one second of training.

use std::time::{Duration, Instant};

use quad_algorithms::{Agent, AlgorithmError, Examples};
use quad_dataset::{BatchSampler, OnlineEpisode, Problem, Split, Transitions};
use quad_run::config::{Device, Experiment};
use quad_run::folder::Checkpoint;

use super::agent::{begin, origin};
use super::held_out::HeldOut;

/// Time of the measurement, of all phases together.
const MEASURED: Duration = Duration::from_secs(1);

/// Timed steps of a phase are a multiple of this: some updates come at each second, fifth or
/// twentieth step.
const CYCLE: u64 = 20;

/// Bytes of an environment step in memory beside its numbers: its place, and marks of its end.
const MARKS: u64 = 9;

/// The cost of a run.
#[derive(Clone, Copy, Default)]
pub(crate) struct RunCost {
    pub step_seconds: f64,
    pub snapshot_bytes: u64,
    pub checkpoint_bytes: u64,
    /// Bytes on disk of an online environment step: observation, action and reward.
    pub row_bytes: u64,
}

impl RunCost {
    /// Measures the first steps of each phase of a run, on the threads of the calling pool, with all
    /// that a run has in memory.
    pub fn measure(experiment: &Experiment, device: Device, data: Split) -> anyhow::Result<Self> {
        let numbers = data.training.observation_dim() + data.training.action_dim() + 1;
        let (mut agent, mut examples) = begin(experiment, device, data.training)?;
        let held_out = data.held_out;
        let held_out = held_out.and_then(|episodes| HeldOut::new(experiment, episodes, &agent));
        if examples.len() == 0 {
            add_row(examples.transitions())?;
        }
        let size = experiment.batch_size as usize;
        let mut sampler = BatchSampler::new(examples.len().max(1), size, experiment.seed, 0);
        let steps = [experiment.steps, experiment.total_steps()];
        let step_seconds = mean_step(&mut agent, &mut examples, &mut sampler, steps)?;
        held_out.map(|mut held_out| held_out.measure(&agent)).transpose()?;
        Ok(Self {
            step_seconds,
            snapshot_bytes: agent.policy(origin(experiment))?.len() as u64,
            checkpoint_bytes: agent.save()?.len() as u64,
            row_bytes: (numbers * size_of::<f32>()) as u64,
        })
    }

    /// Bytes of memory that experience takes by the end of a run of `online.steps`.
    pub fn experience_bytes(&self, steps: u64) -> u64 {
        steps * (self.row_bytes + MARKS)
    }

    /// Bytes on disk of a whole run: its snapshots, the checkpoints that are kept, and experience.
    pub fn bytes(&self, experiment: &Experiment) -> u64 {
        let schedule = experiment.schedule();
        let (mut snapshots, mut rows) = (schedule.evaluations(), 0);
        if let Some(online) = &experiment.online {
            let steps =
                (experiment.steps..schedule.steps).step_by(online.snapshot_interval as usize);
            snapshots += steps.filter(|step| !schedule.is_evaluated(*step)).count() as u64;
            rows = online.steps;
        }
        let kept = Checkpoint::KEPT as u64 * self.checkpoint_bytes;
        snapshots.max(1) * self.snapshot_bytes + kept + rows * self.row_bytes
    }
}

/// Adds a row of experience, so that batches have one without a dataset.
fn add_row(transitions: &Transitions) -> Result<(), Problem> {
    let (o, a) = (transitions.observation_dim(), transitions.action_dim());
    let (observations, actions) = (&vec![0.0; 2 * o], &vec![0.0; a]);
    let episode = OnlineEpisode { observations, actions, rewards: &[0.0], terminated: true };
    transitions.add_episode(episode).map(drop)
}

/// Mean seconds of a gradient step over a run with this number of steps on the dataset alone and in
/// all, weighted by the lengths of its phases.
pub(super) fn mean_step(
    agent: &mut Agent,
    examples: &mut Examples,
    sampler: &mut BatchSampler,
    [offline, total]: [u64; 2],
) -> Result<f64, AlgorithmError> {
    let mut begins = agent.phases();
    begins.extend([offline, total]);
    begins.sort_unstable();
    let phases = begins.windows(2).map(|phase| (phase[0], phase[1]));
    let phases = Vec::from_iter(phases.filter(|(begin, end)| begin < end));
    let mut seconds = 0.0;
    for (begin, end) in &phases {
        agent.skip_to(*begin);
        let mut step = || {
            if agent.step() == *end {
                agent.skip_to(*begin);
            }
            let indices = sampler.next_indices();
            let batch = match agent.step() < offline {
                true => examples.batch(indices)?,
                false => examples.online_batch(indices)?,
            };
            agent.update(&batch)
        };
        // The first step also allocates buffers.
        step()?;
        let (start, mut done) = (Instant::now(), 0);
        while done == 0 || start.elapsed() < MEASURED / phases.len() as u32 {
            (0..CYCLE).try_for_each(|_| step().map(drop))?;
            done += CYCLE;
        }
        seconds += start.elapsed().as_secs_f64() / done as f64 * (end - begin) as f64;
    }
    Ok(seconds / total as f64)
}
