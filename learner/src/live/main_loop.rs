//! The main loop of a run: reports events, and decides when the run is over.

use std::time::{Duration, Instant};

use quad_run::folder::RunDir;
use quad_run::results::Spread;
use quad_runtime::{Endpoints, Health, Heartbeat};
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::task::JoinHandle;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::{error, warn};

use super::display::{Display, evaluators};
use super::duplicate::Incarnation;
use super::events::{Event, Saved};
use super::metrics::Metrics;
use super::network::{Online, Opening, Wire, go_online};
use super::patience::{Patience, Verdict, how_to_evaluate};
use super::threads::{STUCK, Threads};
use crate::local_evaluators::LocalEvaluators;
use crate::train::Outcome;

/// When so many evaluations wait for scores, the evaluators are slower than the training.
const BEHIND: usize = 3;
/// Time limit for closing the session, if the network hangs.
const CLOSE_PATIENCE: Duration = Duration::from_secs(5);
/// After this time a failed run gives up output that waits for the disk: the disk may be in
/// trouble, too.
const LAST_WRITES: Duration = Duration::from_secs(15);

/// How a run ended.
#[derive(Debug)]
pub(crate) enum Ending {
    /// Training is complete, and every episode has a score or was given up.
    Complete,
    /// The user asked to stop, by a signal.
    Interrupted,
    /// Training is complete, but no evaluator came that may have the run's environment.
    Unscored,
    /// The run could not continue.
    Failed(anyhow::Error),
}

/// What the loop needs.
pub(crate) struct MainLoop {
    pub incarnation: Incarnation,
    pub run_dir: RunDir,
    pub metrics: Metrics,
    /// The address of `/metrics`.
    pub metrics_address: String,
    /// Where the learner listens or connects, as the command line asks.
    pub endpoints: Endpoints,
    pub events: UnboundedReceiver<Event>,
    pub threads: Threads,
    pub display: Display,
    pub health: Health,
    /// Reports that this loop is alive. It is not if a full pipe blocks its output.
    pub beat: Heartbeat,
    /// The evaluators that it starts.
    pub evaluators: LocalEvaluators,
}

/// The state of the run, as far as the loop knows.
#[derive(Default)]
struct Reached {
    trained: bool,
    interrupted: bool,
    wire: Option<Wire>,
    /// Where evaluators can reach the run; empty until it is online.
    reachable_at: Vec<String>,
    /// Outputs whose disk hangs, as reported.
    hangs: Vec<Saved>,
    /// Whether it was said that the evaluators are slow.
    is_behind: bool,
    patience: Patience,
}

impl MainLoop {
    /// Runs until the end, then ends the threads and the session.
    pub async fn run(mut self, opening: Opening) -> Ending {
        let online = tokio::spawn(go_online(
            opening,
            self.endpoints.clone(),
            self.incarnation.clone(),
            self.threads.services.clone(),
            self.run_dir.clone(),
            self.metrics_address.clone(),
        ));
        let mut reached = Reached::default();
        let mut ending = self.watch(online, &mut reached).await;
        self.display.finish();
        // All that the ending takes happens at the same time: after a signal there is little of it.
        tokio::join!(end(self.threads, &ending), self.evaluators.end());
        while let Ok(event) = self.events.try_recv() {
            match (event, &ending) {
                // The reason of the failure is known already.
                (Event::Failed(_), Ending::Failed(_)) => {}
                (Event::Failed(error), _) => ending = Ending::Failed(error),
                (event, _) => tell(event, &mut self.display),
            }
        }
        if let Some(wire) = reached.wire {
            // An evaluator that misses this message notices the lost connection.
            timeout(CLOSE_PATIENCE, tokio::spawn(wire.close())).await.ok();
        }
        ending
    }

    async fn watch(
        &mut self,
        mut online: JoinHandle<anyhow::Result<Online>>,
        reached: &mut Reached,
    ) -> Ending {
        let mut shutdown =
            std::pin::pin!(quad_runtime::shutdown_signal(quad_runtime::LEAVE_WITHIN));
        let mut ticker = interval(self.display.interval());
        ticker.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut is_online = false;
        loop {
            tokio::select! {
                result = &mut online, if !is_online => {
                    is_online = true;
                    match result.map_err(anyhow::Error::from).flatten() {
                        Ok(online) => {
                            if let Err(error) = self.online(online, reached) {
                                return Ending::Failed(error);
                            }
                        }
                        Err(error) => return Ending::Failed(error),
                    }
                }
                Some(event) = self.events.recv() => match event {
                    Event::Failed(error) => return Ending::Failed(error),
                    Event::TrainingEnded(Outcome::Stopped { .. }) => return Ending::Interrupted,
                    // The stop came during the last step; the run does not wait for scores.
                    Event::TrainingEnded(Outcome::Completed) if reached.interrupted => return Ending::Interrupted,
                    Event::TrainingEnded(Outcome::Completed) => {
                        reached.trained = true;
                        self.display.say(&self.trained());
                    }
                    event => {
                        let published = matches!(event, Event::Published { .. });
                        tell(event, &mut self.display);
                        if published && !reached.is_behind {
                            reached.is_behind = self.say_if_behind();
                        }
                    }
                },
                _ = ticker.tick() => {
                    if let Verdict::GiveUp = self.tick(reached) {
                        return Ending::Unscored;
                    }
                    if reached.trained && self.threads.services.coordinator.pending() == 0 {
                        return Ending::Complete;
                    }
                }
                () = &mut shutdown, if !reached.interrupted => {
                    reached.interrupted = true;
                    if reached.trained {
                        return Ending::Interrupted;
                    }
                    self.display.say("stopping after this gradient step");
                    self.threads.stop_training();
                }
            }
        }
    }

    fn online(&mut self, online: Online, reached: &mut Reached) -> anyhow::Result<()> {
        let (zenoh, metrics) = (online.reachable_at.join(", "), &self.metrics_address);
        self.display.say(&format!(
            "run {} is at {zenoh}, its metrics at http://{metrics}/metrics",
            self.incarnation.run
        ));
        reached.reachable_at = online.reachable_at;
        reached.wire = Some(online.wire);
        self.evaluators.start(
            &reached.reachable_at,
            self.run_dir.path(),
            self.incarnation.run.as_str(),
        )
    }

    fn trained(&self) -> String {
        match self.threads.services.coordinator.pending() {
            0 => "training is done".to_owned(),
            pending => {
                let present = evaluators(self.metrics.evaluators.present.get());
                format!(
                    "training is done; waiting for the scores of {pending} episodes ({present} here)"
                )
            }
        }
    }

    /// Says that the evaluators are slower than the training, if that is so. A run without any says
    /// so elsewhere.
    fn say_if_behind(&self) -> bool {
        let waiting = self.threads.services.coordinator.evaluations_pending();
        let is_behind = waiting >= BEHIND && self.metrics.evaluators.present.get() > 0;
        if is_behind {
            self.display.say(&format!(
                "the evaluators are slower than the training, which does not wait for them: {waiting} evaluations have no \
                 score yet; more evaluators or a longer --eval-interval end the run sooner"
            ));
        }
        is_behind
    }

    fn tick(&mut self, reached: &mut Reached) -> Verdict {
        self.beat.alive();
        for line in self.threads.services.coordinator.tick() {
            self.display.say(&line);
        }
        self.watch_disk(&mut reached.hangs);
        self.display.tick(Instant::now());
        for line in self.evaluators.news() {
            self.display.say(&line);
        }
        if !reached.trained {
            return Verdict::Wait;
        }
        let verdict =
            reached.patience.look(self.threads.services.coordinator.any_may_fit(), Instant::now());
        if let Verdict::Advise = verdict {
            self.display.say(&self.advice(&reached.reachable_at));
        }
        verdict
    }

    /// A thread that writes and has not reported for long waits for the disk.
    fn watch_disk(&self, told: &mut Vec<Saved>) {
        let hangs: Vec<_> =
            Saved::ALL.into_iter().filter(|what| self.health.is_silent(what.thread())).collect();
        for what in hangs.iter().filter(|what| !told.contains(what)) {
            self.metrics.disk.trouble(*what).set(1);
            let waits = match what {
                Saved::Run => "snapshots and checkpoints wait for it; training continues",
                Saved::Scores => "scores wait for it; evaluators keep theirs",
            };
            let silent = STUCK.as_secs();
            self.display.say(&format!(
                "nothing was saved for {silent} s, as the disk hangs or the machine is too busy: {waits}"
            ));
        }
        *told = hangs;
    }

    fn advice(&self, reachable_at: &[String]) -> String {
        match reachable_at {
            [] => {
                format!(
                    "no router has answered at {} yet; the scores wait for it",
                    self.endpoints.connect.join(", ")
                )
            }
            [endpoint, ..] => how_to_evaluate(
                self.threads.services.coordinator.environment(),
                endpoint,
                self.evaluators.log(),
            ),
        }
    }
}

/// Reports an event.
fn tell(event: Event, display: &mut Display) {
    let text = match event {
        Event::Published { step } => format!("step {step}: snapshot handed to evaluation"),
        Event::GivenUp(episodes) => {
            let episodes = episodes.len();
            format!(
                "{episodes} episodes are given up: too many evaluators were lost with them or could not do them"
            )
        }
        Event::JobFailed { step, evaluator, reason } => {
            format!(
                "evaluator {evaluator} could not do a job of step {step}, which goes to others: {reason}"
            )
        }
        Event::SameName(name) => format!(
            "two evaluators were started with --name {name}, and one of them gets no work; give each a name of its own"
        ),
        Event::Evaluated { step, scores } => {
            let values: Vec<_> = scores.iter().map(|score| score.score).collect();
            let Some(Spread { mean, std, .. }) = Spread::of(&values) else { return };
            display.scored(step, mean);
            let std = std.map(|std| format!(" ± {std:.2}")).unwrap_or_default();
            format!("step {step}: score {mean:.2}{std} over {} episodes", values.len())
        }
        Event::DiskTrouble(what, error) => format!(
            "{} cannot be saved: {error}; training continues, and it is tried again until the disk takes it",
            what.name()
        ),
        Event::DiskWell(what) => format!("{} can be saved again", what.name()),
        Event::TrainingEnded(_) | Event::Failed(_) => return,
    };
    display.say(&text);
}

/// Ends the threads. Those of a failed run get limited time; meanwhile the user reads why it
/// failed.
async fn end(threads: Threads, ending: &Ending) {
    let mut ended = tokio::task::spawn_blocking(|| threads.join());
    let Ending::Failed(error) = ending else { return drop(ended.await) };
    if timeout(Duration::from_secs(1), &mut ended).await.is_ok() {
        return;
    }
    error!(
        "{error:#}; ending as soon as the disk has taken what waits for it, in {} s at most",
        LAST_WRITES.as_secs()
    );
    if timeout(LAST_WRITES, ended).await.is_err() {
        warn!("the disk did not take what was to be saved last");
    }
}
