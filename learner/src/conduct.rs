//! The main loop of a run: connects to the network while the threads work, shows events, decides when the run is over.

use std::thread;
use std::time::{Duration, Instant};

use anyhow::anyhow;
use quad_protocol::Name;
use quad_service::{Beat, Endpoints};
use tokio::runtime::Handle;
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::sync::oneshot;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::{error, warn};
use zenoh::Session;

use crate::display::{Display, evaluators};
use crate::keeper::RETRY;
use crate::metrics::Metrics;
use crate::notice::Notice;
use crate::report::Spread;
use crate::run_dir::{RunDir, RunEndpoints};
use crate::threads::Threads;
use crate::train::Outcome;
use crate::trouble::Saved;
use crate::wire::{Life, Wire};

/// Listening takes milliseconds. A session that takes longer waits for a router; training starts without it.
const SESSION_PATIENCE: Duration = Duration::from_secs(1);
/// When no evaluator has been connected for this long after training, the user is told what to do.
const EVALUATOR_PATIENCE: Duration = Duration::from_secs(10);
/// The disk hangs if it takes longer than this for one file.
pub(crate) const DISK_PATIENCE: Duration = Duration::from_secs(30);
/// Longest time to close the session in, should the network hang.
const CLOSE_PATIENCE: Duration = Duration::from_secs(5);
/// When a run has failed, what still waits for the disk is given up after this time: the disk may be in trouble, too.
const LAST_WRITES: Duration = Duration::from_secs(15);

/// A Zenoh session that may still wait for a router.
pub type Opening = oneshot::Receiver<anyhow::Result<Session>>;

/// Starts to open the session. What cannot work, like listening at a port in use, is an error at once.
pub async fn open_network(endpoints: &Endpoints) -> anyhow::Result<Opening> {
    let (tell, mut opening) = oneshot::channel();
    let (endpoints, runtime) = (endpoints.clone(), Handle::current());
    // Zenoh waits for a router without giving way to other tasks; this thread may, and ends with the process.
    thread::Builder::new().name("session".to_owned()).spawn(move || {
        let session = runtime.block_on(quad_service::open_session(&endpoints));
        tell.send(session.map_err(anyhow::Error::from)).ok();
    })?;
    match timeout(SESSION_PATIENCE, &mut opening).await {
        Ok(session) => {
            let (tell, opened) = oneshot::channel();
            tell.send(Ok(session??)).ok();
            Ok(opened)
        }
        Err(_) => Ok(opening),
    }
}

type Opened = Result<anyhow::Result<Session>, oneshot::error::RecvError>;

/// How a run ended.
#[derive(Debug)]
pub enum Ending {
    /// Trained, and every score is there.
    Complete,
    /// The user asked to stop (SIGINT or SIGTERM).
    Interrupted,
    /// It could not go on.
    Failed(anyhow::Error),
}

/// What the loop watches over.
pub struct Conductor {
    /// Name of the run.
    pub run: Name,
    /// Which start of the learner this is.
    pub incarnation: u64,
    /// Its folder.
    pub run_dir: RunDir,
    /// Its metrics.
    pub metrics: Metrics,
    /// Where its metrics are served.
    pub metrics_address: String,
    /// Where it listens or connects, as it was asked to.
    pub endpoints: Endpoints,
    /// Where evaluators find it; empty until the session is there.
    pub reachable_at: Vec<String>,
    /// Messages from its threads.
    pub notices: UnboundedReceiver<Notice>,
    /// Its threads.
    pub threads: Threads,
    /// The progress display.
    pub display: Display,
    /// Says that this loop is alive: it would not be if nobody took what it prints.
    pub beat: Beat,
}

impl Conductor {
    /// Runs until the end, then ends the threads and the session.
    pub async fn conduct(mut self, opening: Opening) -> anyhow::Result<Ending> {
        let mut wire = None;
        let ending = self.watch(opening, &mut wire).await;
        self.display.finish();
        let ended = end(self.threads, &ending).await;
        let ending = match (ending, ended) {
            // Why a thread ended badly is known already if the run has failed by it.
            (Ending::Failed(error), _) | (_, Err(error)) => Ending::Failed(error),
            (ending, Ok(())) => ending,
        };
        if let Some(wire) = wire {
            // An evaluator that misses the goodbye notices the lost connection.
            timeout(CLOSE_PATIENCE, wire.close()).await.ok();
        }
        Ok(ending)
    }

    async fn watch(&mut self, mut opening: Opening, wire: &mut Option<Wire>) -> Ending {
        let mut shutdown = std::pin::pin!(quad_service::shutdown_signal());
        let mut ticker = interval(self.display.interval());
        ticker.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let (mut training, mut settled, mut interrupted, mut opened) = (true, false, false, false);
        let mut waiting = Waiting::default();
        let mut hangs = false;
        while training || !settled {
            tokio::select! {
                session = &mut opening, if !opened => {
                    opened = true;
                    // To be sure that there is no other learner takes seconds.
                    tokio::select! {
                        online = self.go_online(session) => match online {
                            Ok(online) => *wire = Some(online),
                            Err(error) => return Ending::Failed(error),
                        },
                        () = &mut shutdown, if !interrupted => {
                            interrupted = true;
                            if !training {
                                return Ending::Interrupted;
                            }
                            self.interrupt();
                        }
                    }
                }
                trained = &mut self.threads.trained, if training => {
                    training = false;
                    match trained {
                        // Told to stop during the last step: there was nothing left to stop, but the scores are not waited for.
                        Ok(Ok(Outcome::Completed)) if interrupted => return Ending::Interrupted,
                        Ok(Ok(Outcome::Completed)) => {}
                        Ok(Ok(Outcome::Stopped { .. })) => return Ending::Interrupted,
                        Ok(Err(error)) => return Ending::Failed(error),
                        Err(_) => return Ending::Failed(anyhow!("the training thread panicked")),
                    }
                }
                Some(notice) = self.notices.recv() => match notice {
                    Notice::Settled => settled = true,
                    Notice::Failed(error) => return Ending::Failed(error),
                    notice => self.tell(notice),
                },
                _ = ticker.tick() => {
                    self.beat.alive();
                    self.display.tick(Instant::now());
                    let busy_for = self.threads.desk.busy_for();
                    if busy_for > DISK_PATIENCE && !hangs {
                        self.display.say("the disk hangs: snapshots and checkpoints wait for it; training goes on");
                        self.metrics.disk.trouble(Saved::Run).set(1);
                    }
                    hangs = busy_for > DISK_PATIENCE;
                    if !training && waiting.is_too_long(self.metrics.evaluators.present.get() > 0) {
                        self.display.say(&self.advice());
                    }
                }
                () = &mut shutdown, if !interrupted => {
                    interrupted = true;
                    if !training {
                        return Ending::Interrupted;
                    }
                    self.interrupt();
                }
            }
        }
        Ending::Complete
    }

    fn interrupt(&mut self) {
        self.display.say("stopping after this gradient step");
        self.threads.stop_training();
    }

    async fn go_online(&mut self, session: Opened) -> anyhow::Result<Wire> {
        let session = session??;
        self.reachable_at = quad_service::reachable_at(&session, &self.endpoints).await?;
        let endpoints = RunEndpoints { zenoh: self.reachable_at.clone(), metrics: self.metrics_address.clone() };
        let ready = || write_endpoints(self.run_dir.clone(), endpoints.clone());
        let (hub, publisher) = (&self.threads.hub, &self.threads.publisher);
        let life = Life {
            run: self.run.clone(),
            incarnation: self.incarnation,
            behind_router: !self.endpoints.connect.is_empty(),
        };
        let wire = Wire::declare(session, life, hub, publisher, &self.metrics, ready).await?;
        let (zenoh, metrics) = (endpoints.zenoh.join(", "), &endpoints.metrics);
        self.display.say(&format!("run {} is at {zenoh}, its metrics at http://{metrics}/metrics", self.run));
        Ok(wire)
    }

    fn tell(&mut self, notice: Notice) {
        let text = match notice {
            Notice::Published { step } => format!("step {step}: snapshot handed to evaluation"),
            Notice::EvaluatorJoined(name) => format!("evaluator {name} is here"),
            Notice::EvaluatorLeft(name, 0) => format!("evaluator {name} has left"),
            Notice::EvaluatorLeft(name, jobs) => {
                format!("evaluator {name} has left; its {jobs} unfinished jobs go to others")
            }
            Notice::EvaluatorsChanged { joined, left } => format!("{joined} more evaluators came and {left} left"),
            Notice::GivenUp(episodes) => {
                let episodes = episodes.len();
                format!(
                    "{episodes} episodes are given up: too many evaluators were lost with them or could not do them"
                )
            }
            Notice::JobFailed { step, evaluator, reason } => {
                format!("evaluator {evaluator} could not do a job of step {step}, which goes to others: {reason}")
            }
            Notice::JobsExpired(jobs) => format!("{jobs} jobs made no progress; they go to others"),
            Notice::Evaluated { step, scores } => {
                let values: Vec<_> = scores.iter().map(|score| score.score).collect();
                let Some(Spread { mean, std, .. }) = Spread::of(&values) else { return };
                self.display.scored(step, mean);
                let std = std.map(|std| format!(" ± {std:.2}")).unwrap_or_default();
                format!("step {step}: score {mean:.2}{std} over {} episodes", values.len())
            }
            Notice::Trained { pending: 0 } => "training is done".to_owned(),
            Notice::Trained { pending } => {
                let present = evaluators(self.metrics.evaluators.present.get());
                format!("training is done; waiting for the scores of {pending} episodes ({present} here)")
            }
            Notice::Unchecked(episodes) => {
                format!(
                    "{episodes} episodes were not checked: no other evaluator of the same arithmetic was there for them"
                )
            }
            Notice::ScoresDiffer([first, second]) => {
                format!("evaluators {first} and {second} differ in the score of an episode: see audits.jsonl")
            }
            Notice::DiskTrouble(what, error) => format!(
                "{} cannot be saved: {error}; training goes on, and it is tried again until the disk takes it",
                what.name()
            ),
            Notice::DiskWell(what) => format!("{} can be saved again", what.name()),
            Notice::Settled | Notice::Failed(_) => return,
        };
        self.display.say(&text);
    }

    fn advice(&self) -> String {
        match &self.reachable_at[..] {
            [] => {
                format!("no router has answered at {} yet; the scores wait for it", self.endpoints.connect.join(", "))
            }
            [endpoint, ..] => format!("no evaluator is here; start one with: evaluator serve --connect {endpoint}"),
        }
    }
}

/// Ends the threads. Those of a run that has failed get some time for it, in which its user is told why.
async fn end(threads: Threads, ending: &Ending) -> anyhow::Result<()> {
    let mut ended = tokio::task::spawn_blocking(|| threads.join());
    let Ending::Failed(error) = ending else { return ended.await? };
    if let Ok(ended) = timeout(Duration::from_secs(1), &mut ended).await {
        return ended?;
    }
    error!("{error:#}; ending as soon as the disk has taken what waits for it, in {} s at most", LAST_WRITES.as_secs());
    match timeout(LAST_WRITES, ended).await {
        Ok(ended) => ended?,
        Err(_) => {
            warn!("the disk did not take what was to be saved last");
            Ok(())
        }
    }
}

/// Writes where the learner can be reached, as soon as the disk takes it. Nothing but the user's scripts needs it.
fn write_endpoints(run_dir: RunDir, endpoints: RunEndpoints) -> anyhow::Result<()> {
    let work = move || {
        let mut said = false;
        while let Err(error) = run_dir.write_endpoints(&endpoints) {
            if !said {
                said = true;
                warn!("{:#}; it is tried again until the disk takes it", anyhow::Error::from(error));
            }
            thread::sleep(RETRY);
        }
    };
    thread::Builder::new().name("endpoints".to_owned()).spawn(work)?;
    Ok(())
}

/// For how long no evaluator has been connected.
#[derive(Default)]
struct Waiting {
    since: Option<Instant>,
    said: bool,
}

impl Waiting {
    /// True once, each time that it becomes too long.
    fn is_too_long(&mut self, somebody_there: bool) -> bool {
        if somebody_there {
            *self = Self::default();
            return false;
        }
        let since = *self.since.get_or_insert_with(Instant::now);
        if self.said || since.elapsed() < EVALUATOR_PATIENCE {
            return false;
        }
        self.said = true;
        true
    }
}
