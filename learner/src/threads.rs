//! The threads of a run, started together and ended in order.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use anyhow::anyhow;
use quad_dataset::{BatchSampler, Task, Transitions};
use quad_protocol::Name;
use tokio::sync::mpsc::UnboundedSender;
use tokio::sync::oneshot;
use tracing::warn;

use crate::agent::Agent;
use crate::algorithms::Setting;
use crate::config::{Experiment, RunConfig};
use crate::device::Device;
use crate::hub::{self, EvaluationPlan, Hub};
use crate::inbox::{Inbox, inbox};
use crate::metrics::{Metrics, TrainingMetrics};
use crate::notice::Notice;
use crate::publisher::{self, Identity, SnapshotPublisher};
use crate::run_dir::{Log, RunDir};
use crate::scoreboard::{Rules, Scoreboard};
use crate::train::{Outcome, Outlets, Plan, Row, train};

/// Episodes in one job: two evaluators share an evaluation of ten.
const JOB_EPISODES: usize = 5;
/// An evaluator tells its progress about once a second, and Zenoh notices a lost one after about 5 s.
const LEASE: Duration = Duration::from_secs(15);
/// Lines of `metrics.jsonl` that may wait for the disk.
const ROWS_WAITING: usize = 1024;

/// How training ended.
pub type TrainingResult = anyhow::Result<Outcome>;

/// The running threads.
pub struct Threads {
    /// Reaches the thread that publishes snapshots.
    pub publisher: Inbox<publisher::Event>,
    /// Reaches the thread that owns the scoreboard.
    pub hub: Inbox<hub::Event>,
    /// Told once how training ended; fails if its thread panicked.
    pub trained: oneshot::Receiver<TrainingResult>,
    stop: Arc<AtomicBool>,
    training: JoinHandle<()>,
    rows: JoinHandle<()>,
    publisher_thread: JoinHandle<()>,
    hub_thread: JoinHandle<()>,
}

impl Threads {
    /// Starts them all.
    pub fn start(
        run: &Name,
        config: &RunConfig,
        transitions: Transitions,
        run_dir: &RunDir,
        metrics: &Metrics,
        notices: &UnboundedSender<Notice>,
    ) -> anyhow::Result<Self> {
        let experiment = &config.experiment;
        let task = Task::new(&experiment.environment, transitions.observation_dim(), transitions.action_dim());
        let rules = Rules {
            run: run.clone(),
            incarnation: config.run.incarnation,
            task: task.clone(),
            instance: experiment.seed,
            candidates: experiment.candidates,
            job_episodes: JOB_EPISODES,
            lease: LEASE,
        };
        let plan = EvaluationPlan { seed: experiment.seed, episodes: experiment.episodes };
        let scores = run_dir.score_log()?;
        let state = Hub::new(run.clone(), plan, Scoreboard::new(rules), scores, metrics.clone(), notices.clone());
        let (hub, hub_messages) = inbox();
        let hub_thread = spawn("hub", move || state.run(&hub_messages))?;

        let identity = Identity {
            run: run.clone(),
            incarnation: config.run.incarnation,
            task,
            plan,
            candidates: experiment.candidates,
        };
        let state = SnapshotPublisher::new(identity, run_dir.clone(), metrics.clone(), hub.clone(), notices.clone());
        let (publisher, publisher_messages) = inbox();
        let publisher_thread = spawn("publisher", move || state.run(&publisher_messages))?;

        let (row_sender, row_receiver) = sync_channel(ROWS_WAITING);
        let log = run_dir.metrics_log()?;
        let rows = spawn("metrics", move || write_rows(&row_receiver, log))?;

        let stop = Arc::new(AtomicBool::new(false));
        let (tell, trained) = oneshot::channel();
        let trainer = Trainer {
            experiment: experiment.clone(),
            device: config.run.device,
            transitions,
            metrics: metrics.training.clone(),
            rows: row_sender,
            publisher: publisher.clone(),
            stop: stop.clone(),
        };
        let training = spawn("training", move || {
            // Nobody listens any more if the process is ending.
            tell.send(trainer.run()).ok();
        })?;
        Ok(Self { publisher, hub, trained, stop, training, rows, publisher_thread, hub_thread })
    }

    /// Asks training to end after its current step.
    pub fn stop_training(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Ends them all: snapshots and scores that were handed over are on disk afterwards.
    pub fn join(self) -> anyhow::Result<()> {
        self.stop_training();
        finish("training", self.training)?;
        finish("metrics", self.rows)?;
        self.publisher.send(publisher::Event::Stop);
        finish("publisher", self.publisher_thread)?;
        self.hub.send(hub::Event::Stop);
        finish("hub", self.hub_thread)
    }
}

fn spawn(name: &str, work: impl FnOnce() + Send + 'static) -> std::io::Result<JoinHandle<()>> {
    thread::Builder::new().name(name.to_owned()).spawn(work)
}

fn finish(name: &str, thread: JoinHandle<()>) -> anyhow::Result<()> {
    thread.join().map_err(|_| anyhow!("the thread `{name}` panicked"))
}

struct Trainer {
    experiment: Experiment,
    device: Device,
    transitions: Transitions,
    metrics: TrainingMetrics,
    rows: SyncSender<Row>,
    publisher: Inbox<publisher::Event>,
    stop: Arc<AtomicBool>,
}

impl Trainer {
    fn run(self) -> TrainingResult {
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
        let mut sampler = BatchSampler::new(self.transitions.len(), setting.batch_size, experiment.seed, agent.step());
        let outlets = Outlets {
            metrics: self.metrics,
            rows: self.rows,
            snapshot: &|policy| self.publisher.send(publisher::Event::Trained(policy)),
            stop: &self.stop,
        };
        let plan = Plan { steps: experiment.steps, eval_interval: experiment.eval_interval };
        let outcome = train(&mut agent, &self.transitions, &mut sampler, plan, &outlets)?;
        if outcome == Outcome::Completed {
            self.publisher.send(publisher::Event::TrainingCompleted);
        }
        Ok(outcome)
    }
}

fn write_rows(rows: &Receiver<Row>, mut log: Log) {
    let mut warned = false;
    for row in rows {
        if let Err(error) = log.append(&[row])
            && !warned
        {
            warned = true;
            warn!(%error, "training metrics cannot be saved; training goes on");
        }
    }
}
