//! The threads of a run, started together and ended in order.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use quad_algorithms::Agent;
use quad_dataset::Task;
use quad_run::config::{Experiment, RunConfig};
use quad_run::folder::{Log, ResumePoint, RunDir, SavedScores};
use quad_runtime::Health;

use super::coordinator::{Coordinator, EvaluationPlan};
use super::disk::DiskStatus;
use super::duplicate::Incarnation;
use super::events::{Events, Saved};
use super::metrics::Metrics;
use super::page_state::Live;
use super::scores::Scores;
use super::services::Services;
use super::snapshots::Snapshots;
use super::spawn::spawn_alive;
use super::weights::Weights;
use crate::evaluation::Rules;
use crate::train::{HeldOut, Outbox, Training};

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
    /// The run's folder.
    pub dir: &'a RunDir,
    /// The run's scores, open for appending.
    pub scores: Log,
    /// What earlier processes of this run have reached.
    pub past: ResumePoint,
    /// Least time between two checkpoints.
    pub checkpoint_every: Duration,
}

/// The running threads.
pub(crate) struct Threads {
    pub(super) services: Services,
    outbox: Outbox,
    stop: Arc<AtomicBool>,
    training: JoinHandle<()>,
    snapshots: JoinHandle<()>,
    scores: JoinHandle<()>,
}

impl Threads {
    /// Starts all threads.
    pub fn start(
        run: Run<'_>,
        task: Task,
        (agent, held_out): (Agent, Option<HeldOut>),
        metrics: &Metrics,
        health: &Health,
        events: &Events,
    ) -> anyhow::Result<Self> {
        let Run { incarnation, config, dir, scores, past, checkpoint_every } = run;
        let ResumePoint { checkpoint, snapshots: known, scores: earlier } = past;
        let experiment = &config.experiment;
        let coordinator = coordinator(&incarnation, experiment, task, earlier, metrics, events);
        for (&step, &hash) in &known {
            coordinator.open(step, hash)?;
        }
        let weights =
            Weights::new(incarnation.run, incarnation.number, dir.clone(), coordinator.clone());
        let (services, deliveries) =
            Services::start(coordinator.clone(), weights.clone(), metrics.clone(), events.clone())?;

        let disk = |what| DiskStatus::new(what, &metrics.disk, events.clone());
        let scores = Scores {
            log: scores,
            deliveries,
            coordinator,
            metrics: metrics.clone(),
            disk: disk(Saved::Scores),
        };
        let writer = Saved::Scores.thread();
        let scores = spawn_alive(writer, events, health.register(writer, STUCK), move |beat| {
            scores.run(beat)
        })?;

        let step = checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.step);
        metrics.training.gradient_steps.inc_by(step);
        let (rows, seconds_before) = dir.metrics_log(step)?;
        let outbox = Outbox::default();
        let snapshots = Snapshots {
            outbox: outbox.clone(),
            run_dir: dir.clone(),
            rows,
            weights,
            metrics: metrics.clone(),
            events: events.clone(),
            known,
            disk: disk(Saved::Run),
        };
        let writer = Saved::Run.thread();
        let snapshots = spawn_alive(writer, events, health.register(writer, STUCK), move |beat| {
            snapshots.run(beat)
        })?;

        let stop = Arc::new(AtomicBool::new(false));
        let training = Training {
            experiment: experiment.clone(),
            agent,
            held_out,
            checkpoint,
            checkpoint_every,
            seconds_before,
            metrics: metrics.training.clone(),
            outbox: outbox.clone(),
            stop: stop.clone(),
        };
        let training = spawn_alive(
            "training",
            events,
            health.register("training", TRAINING_STUCK),
            move |beat| training.run(beat),
        )?;
        Ok(Self { services, outbox, stop, training, snapshots, scores })
    }

    /// Shows the shared state of jobs and scores on the page.
    pub fn show_on(&self, live: &Live) {
        live.begun(self.services.coordinator.clone());
    }

    /// Asks training to end after its current step.
    pub fn stop_training(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Ends the threads: their output is on the disk afterwards. A thread that failed has told the
    /// main loop.
    pub fn join(self) {
        self.stop_training();
        self.training.join().ok();
        self.outbox.close();
        self.snapshots.join().ok();
        self.services.deliveries.send(None).ok();
        self.scores.join().ok();
    }
}

/// The shared state of jobs and scores, at the start of this process.
fn coordinator(
    incarnation: &Incarnation,
    experiment: &Experiment,
    task: Task,
    earlier: BTreeMap<u64, SavedScores>,
    metrics: &Metrics,
    events: &Events,
) -> Coordinator {
    let rules = Rules {
        run: incarnation.run.clone(),
        incarnation: incarnation.number,
        task,
        environment_seed: experiment.seed,
        job_episodes: JOB_EPISODES,
        lease: LEASE,
    };
    let plan = EvaluationPlan { seed: experiment.seed, episodes: experiment.episodes };
    Coordinator::new(rules, plan, earlier, metrics.clone(), events.clone())
}
