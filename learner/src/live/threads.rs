//! The threads of a run, started together and ended in order.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use quad_algorithms::{Agent, Examples};
use quad_dataset::{BatchSampler, Task, Transitions};
use quad_run::config::{Experiment, RunConfig};
use quad_run::folder::{Log, ResumePoint, RunDir};
use quad_runtime::Health;

use super::carrier::Carrier;
use super::disk::{DiskStatus, Writer};
use super::duplicate::Incarnation;
use super::events::Events;
use super::experience::Experience;
use super::metrics::Metrics;
use super::results::Results;
use super::services::Services;
use super::snapshots::Snapshots;
use super::spawn::spawn_alive;
use super::weights::Weights;
use crate::service::{Rules, Service};
use crate::train::{HeldOut, OutputQueue, Training, origin, resume};

/// Most episodes in one job, so that two evaluators share an evaluation of ten; and most when
/// hundreds wait.
const JOB_EPISODES: [usize; 2] = [5, 40];
/// Lease of a job, which every step of its environments extends. A step of Diffuser's, which plans
/// for each episode, takes an evaluator up to a minute; Zenoh notices a lost evaluator after 5 s.
const LEASE: Duration = Duration::from_secs(180);
/// A thread that answers or writes is stuck if it has not reported for this long.
pub(crate) const STUCK: Duration = Duration::from_secs(30);
/// Training is stuck if it has not reported for this long; its slowest steps take seconds.
const TRAINING_STUCK: Duration = Duration::from_secs(300);

/// A run and its state.
pub(crate) struct Run<'a> {
    pub incarnation: Incarnation,
    pub config: &'a RunConfig,
    pub dir: &'a RunDir,
    pub task: Task,
    pub agent: Agent,
    pub examples: Examples,
    pub held_out: Option<HeldOut>,
    /// The run's scores, open for appending.
    pub scores: Log,
    /// State that earlier processes of this run have reached.
    pub past: ResumePoint,
    /// Least time between two checkpoints.
    pub checkpoint_every: Duration,
}

pub(crate) struct Threads {
    pub(super) services: Services,
    queue: OutputQueue,
    stop: Arc<AtomicBool>,
    training: JoinHandle<()>,
    snapshots: JoinHandle<()>,
    results: JoinHandle<()>,
}

impl Threads {
    /// Starts all threads.
    pub fn start(
        run: Run<'_>,
        metrics: &Metrics,
        health: &Health,
        events: &Events,
    ) -> anyhow::Result<Self> {
        let Run { incarnation, config, dir, past, mut agent, examples, .. } = run;
        let ResumePoint { checkpoint, snapshots: saved, scores: earlier } = past;
        let experiment = &config.experiment;
        let step = checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.step);
        if let Some(checkpoint) = checkpoint {
            resume(&mut agent, &checkpoint)?;
        }
        let transitions = examples.transitions().clone();
        let rules = rules(&incarnation, experiment, run.task, &transitions);
        let experience = Experience::open(dir, experiment, step, transitions, &metrics.online)?;
        let (online, inbox, experience, episodes) = match experience {
            Some(Experience { training, inbox, log, episodes }) => {
                (Some(training), Some(inbox), Some(log), episodes)
            }
            None => (None, None, None, Vec::new()),
        };
        let service = Service::new(rules, earlier, &episodes, Instant::now());
        let carrier = Carrier::new(service, metrics.clone(), events.clone(), inbox);
        let schedule = experiment.schedule();
        for (&step, &hash) in saved.iter().filter(|(step, _)| schedule.is_evaluated(**step)) {
            carrier.open(step, hash)?;
        }
        let weights = Weights::new(incarnation, dir.clone());
        let services = Services::start(carrier.clone(), weights.clone())?;

        let disk = |writer| DiskStatus::new(writer, metrics.disk_trouble(writer), events.clone());
        let (writer, scores) = (Writer::SCORES, run.scores);
        let results = Results { scores, experience, carrier: carrier.clone(), disk: disk(writer) };
        let beat = health.register(writer.thread, STUCK);
        let results = spawn_alive(writer.thread, events, beat, move |beat| results.run(beat))?;

        metrics.training.gradient_steps.inc_by(step);
        let (rows, seconds_before) = dir.metrics_log(step)?;
        let queue = OutputQueue::default();
        let disk = disk(Writer::SNAPSHOTS);
        let snapshots = Snapshots { queue: queue.clone(), rows, weights, carrier, saved, disk };
        let writer = Writer::SNAPSHOTS.thread;
        let beat = health.register(writer, STUCK);
        let snapshots = spawn_alive(writer, events, beat, move |beat| snapshots.run(beat))?;

        let stop = Arc::new(AtomicBool::new(false));
        let size = experiment.batch_size as usize;
        // Without a dataset nothing is drawn from it.
        let sampler = BatchSampler::new(examples.len().max(1), size, experiment.seed, step);
        let training = Training {
            sampler,
            examples,
            agent,
            online,
            held_out: run.held_out,
            schedule,
            origin: origin(experiment),
            checkpoint_every: run.checkpoint_every,
            seconds_before,
            metrics: metrics.training.clone(),
            queue: queue.clone(),
            stop: stop.clone(),
        };
        let beat = health.register("training", TRAINING_STUCK);
        let training = spawn_alive("training", events, beat, move |beat| training.run(beat))?;
        Ok(Self { services, queue, stop, training, snapshots, results })
    }

    /// The run's state of jobs and results.
    pub fn carrier(&self) -> &Carrier {
        &self.services.carrier
    }

    /// Asks training to end after its current step.
    pub fn stop_training(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Ends the threads: their output is on the disk afterwards. A thread that failed has reported
    /// it to the main loop.
    pub fn join(self) {
        self.stop_training();
        self.training.join().ok();
        self.queue.close();
        self.snapshots.join().ok();
        self.services.carrier.close();
        self.results.join().ok();
    }
}

fn rules(
    Incarnation { run, number }: &Incarnation,
    experiment: &Experiment,
    task: Task,
    transitions: &Transitions,
) -> Rules {
    Rules {
        run: run.clone(),
        incarnation: *number,
        task,
        seed: experiment.seed,
        dims: (transitions.observation_dim(), transitions.action_dim()),
        episodes: experiment.episodes,
        schedule: experiment.schedule(),
        job_episodes: JOB_EPISODES,
        lease: LEASE,
    }
}
