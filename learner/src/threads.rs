//! The threads of a run, started together and ended in order.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel, sync_channel};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use anyhow::anyhow;
use quad_dataset::{Task, Transitions};
use quad_protocol::Name;
use quad_service::{Beat, Health};
use tokio::sync::mpsc::UnboundedSender;
use tokio::sync::oneshot;

use crate::config::RunConfig;
use crate::hub::{self, EvaluationPlan, Hub};
use crate::inbox::{Inbox, inbox};
use crate::keeper::{Desk, Keeper, Provenance};
use crate::metrics::Metrics;
use crate::notice::Notice;
use crate::publisher::{self, Identity, SnapshotPublisher};
use crate::resume::Past;
use crate::run_dir::{Log, PatientLog, RunDir};
use crate::scoreboard::{Rules, Scoreboard};
use crate::scribe::Scribe;
use crate::train::Row;
use crate::trainer::{Trainer, TrainingResult};
use crate::trouble::{Saved, Trouble};

/// Most episodes in one job: two evaluators share an evaluation of ten. And most if hundreds wait.
const JOB_EPISODES: [usize; 2] = [5, 40];
/// An evaluator tells its progress three times meanwhile or more often, and Zenoh notices a lost one after about 5 s.
const LEASE: Duration = Duration::from_secs(15);
/// A thread that answers others, or writes to the disk, is stuck if it has said nothing for so long.
pub(crate) const STUCK: Duration = Duration::from_secs(30);
/// So is training, whose slowest steps take seconds.
const TRAINING_STUCK: Duration = Duration::from_secs(300);
/// Lines of `metrics.jsonl` that may wait for the disk.
const ROWS_WAITING: usize = 1024;

/// The running threads.
pub struct Threads {
    /// Reaches the thread that publishes snapshots.
    pub publisher: Inbox<publisher::Event>,
    /// Reaches the thread that owns the scoreboard.
    pub hub: Inbox<hub::Event>,
    /// Told once how training ended; fails if its thread panicked.
    pub trained: oneshot::Receiver<TrainingResult>,
    /// Where results wait for the disk.
    pub desk: Desk,
    stop: Arc<AtomicBool>,
    training: Thread,
    rows: Thread,
    keeper: Thread,
    publisher_thread: Thread,
    hub_thread: Thread,
    scribe: Thread,
}

/// What a run is, and how far it is.
pub struct Run<'a> {
    /// Its name.
    pub name: Name,
    /// Which start of its learner this is: a later one has a larger number.
    pub incarnation: u64,
    /// Its configuration.
    pub config: &'a RunConfig,
    /// Its folder.
    pub dir: &'a RunDir,
    /// Its scores, to be appended to.
    pub scores: Log,
    /// What earlier learners have reached.
    pub past: Past,
    /// Least time between two checkpoints.
    pub checkpoint_every: Duration,
    /// Share of the episodes that are scored twice.
    pub audit: f64,
}

impl Threads {
    /// Starts them all.
    pub fn start(
        run: Run<'_>,
        transitions: Transitions,
        metrics: &Metrics,
        health: &Health,
        notices: &UnboundedSender<Notice>,
    ) -> anyhow::Result<Self> {
        let Run { name, incarnation, config, dir, scores, past, checkpoint_every, audit } = run;
        let Past { checkpoint, snapshots, scores: earlier } = past;
        let experiment = &config.experiment;
        let task = Task::new(&experiment.environment, transitions.observation_dim(), transitions.action_dim());
        let rules = Rules {
            run: name.clone(),
            incarnation,
            task: task.clone(),
            instance: experiment.seed,
            candidates: experiment.candidates,
            job_episodes: JOB_EPISODES,
            lease: LEASE,
            audit,
        };
        let plan = EvaluationPlan { seed: experiment.seed, episodes: experiment.episodes };
        let mut scoreboard = Scoreboard::new(rules);
        scoreboard.remember(earlier);
        let audits = if audit > 0.0 { Some(PatientLog::new(dir.audit_log()?)) } else { None };
        let (hub, hub_messages) = inbox();
        let (sender, lines) = channel();
        let trouble = Trouble::new(Saved::Scores, &metrics.disk, notices.clone());
        let scribe = Scribe { scores, audits, lines, hub: hub.clone(), trouble };
        let scribe = spawn("scribe", notices, with(health.part("scribe", STUCK), move |beat| scribe.run(beat)))?;
        let state = Hub::new(name.clone(), plan, scoreboard, sender, metrics.clone(), notices.clone());
        let hub_thread =
            spawn("hub", notices, with(health.part("hub", STUCK), move |beat| state.run(&hub_messages, beat)))?;

        let identity = Identity { run: name, incarnation, task: task.clone() };
        let state = SnapshotPublisher::new(
            identity,
            dir.clone(),
            metrics.clone(),
            hub.clone(),
            notices.clone(),
            snapshots.clone(),
        );
        let (publisher, publisher_messages) = inbox();
        let publisher_thread = spawn(
            "publisher",
            notices,
            with(health.part("publisher", STUCK), move |beat| state.run(&publisher_messages, beat)),
        )?;

        let desk = Desk::default();
        let provenance = Provenance { task, plan, candidates: experiment.candidates };
        let state = Keeper::new(
            desk.clone(),
            provenance,
            dir.clone(),
            metrics.clone(),
            publisher.clone(),
            notices.clone(),
            snapshots,
        );
        let keeper = spawn("keeper", notices, with(health.part("keeper", STUCK), move |beat| state.run(beat)))?;

        let step = checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.step);
        metrics.training.gradient_steps.inc_by(step);
        let (row_sender, row_receiver) = sync_channel(ROWS_WAITING);
        let (log, seconds_before) = dir.metrics_log(step)?;
        let rows = spawn("metrics", notices, move || write_rows(&row_receiver, log))?;

        let stop = Arc::new(AtomicBool::new(false));
        let (tell, trained) = oneshot::channel();
        let trainer = Trainer {
            experiment: experiment.clone(),
            device: config.run.device,
            transitions,
            checkpoint,
            checkpoint_every,
            seconds_before,
            metrics: metrics.training.clone(),
            rows: row_sender,
            desk: desk.clone(),
            stop: stop.clone(),
        };
        let work = move |beat: &Beat| {
            // Nobody listens any more if the process is ending.
            tell.send(trainer.run(beat)).ok();
        };
        let training = spawn("training", notices, with(health.part("training", TRAINING_STUCK), work))?;
        Ok(Self { publisher, hub, trained, desk, stop, training, rows, keeper, publisher_thread, hub_thread, scribe })
    }

    /// Asks training to end after its current step.
    pub fn stop_training(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// Ends them all: snapshots and scores that were handed over are on disk afterwards.
    pub fn join(self) -> anyhow::Result<()> {
        self.stop_training();
        let training = finish("training", self.training);
        let metrics = finish("metrics", self.rows);
        self.desk.close();
        let keeper = finish("keeper", self.keeper);
        self.publisher.send(publisher::Event::Stop);
        let publisher = finish("publisher", self.publisher_thread);
        self.hub.send(hub::Event::Stop);
        let hub = finish("hub", self.hub_thread);
        // One that ended badly does not keep the others from what they still have to write.
        [training, metrics, keeper, publisher, hub, finish("scribe", self.scribe)].into_iter().collect()
    }
}

/// A thread, and at its end whether it panicked.
type Thread = JoinHandle<Result<(), Panicked>>;

#[derive(Debug, thiserror::Error)]
#[error("the thread `{thread}` panicked, which is a bug of this program: {message}")]
struct Panicked {
    thread: String,
    message: String,
}

/// Work that says that it is alive, and when it is done. If it panics its health says so.
fn with(beat: Beat, work: impl FnOnce(&Beat)) -> impl FnOnce() {
    move || {
        work(&beat);
        beat.finish();
    }
}

/// Starts a thread. If it panics the run ends: without it the process would look alive and do nothing.
fn spawn(
    name: &str,
    notices: &UnboundedSender<Notice>,
    work: impl FnOnce() + Send + 'static,
) -> std::io::Result<Thread> {
    let notices = notices.clone();
    spawn_or(name, move |error| drop(notices.send(Notice::Failed(error))), work)
}

/// The same for a thread of the network's side, which ends with the process.
pub(crate) fn spawn_for_hub(
    name: &str,
    hub: &Inbox<hub::Event>,
    work: impl FnOnce() + Send + 'static,
) -> std::io::Result<()> {
    let hub = hub.clone();
    spawn_or(name, move |error| hub.send(hub::Event::Failed(error)), work).map(drop)
}

fn spawn_or(
    name: &str,
    failed: impl FnOnce(anyhow::Error) + Send + 'static,
    work: impl FnOnce() + Send + 'static,
) -> std::io::Result<Thread> {
    let thread = name.to_owned();
    thread::Builder::new().name(name.to_owned()).spawn(move || {
        catch_unwind(AssertUnwindSafe(work)).map_err(|payload| {
            let panicked = Panicked { thread, message: message(payload.as_ref()) };
            failed(anyhow!("{panicked}"));
            panicked
        })
    })
}

fn message(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| payload.downcast_ref::<String>().cloned()).unwrap_or_default()
}

fn finish(name: &str, thread: Thread) -> anyhow::Result<()> {
    Ok(thread.join().map_err(|_| anyhow!("the thread `{name}` panicked"))??)
}

fn write_rows(rows: &Receiver<Row>, log: Log) {
    let mut log = PatientLog::new(log);
    for row in rows {
        log.append([row]);
    }
    log.append([]);
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use tokio::sync::mpsc::unbounded_channel;

    #[test]
    fn a_thread_that_panics_fails_the_run_and_says_so_at_its_end() {
        let (notify, mut notices) = unbounded_channel();
        let thread = spawn("hub", &notify, || panic!("a test's own {}", "panic")).unwrap();
        drop(notify);
        let Some(Notice::Failed(error)) = notices.blocking_recv() else { panic!("no notice") };
        assert!(error.to_string().contains("`hub` panicked") && error.to_string().contains("a test's own panic"));
        assert!(finish("hub", thread).is_err());
        let (hub, messages) = inbox();
        spawn_for_hub("reply", &hub, || panic!("another")).unwrap();
        let Ok(Some(hub::Event::Failed(error))) = messages.next(Duration::from_secs(20)) else { panic!("no event") };
        assert!(error.to_string().contains("`reply` panicked"), "{error}");
        let (notify, _notices) = unbounded_channel();
        finish("hub", spawn("hub", &notify, || ()).unwrap()).unwrap();
    }
}
