//! The main loop of a run: reports events, and decides when the run is over.

use std::mem;
use std::time::Duration;

use quad_run::counted;
use quad_run::folder::RunDir;
use quad_run::results::Spread;
use quad_runtime::{Endpoints, Health, Heartbeat, LEAVE_WITHIN, shutdown_signal};
use tokio::sync::mpsc::UnboundedReceiver;
use tokio::task::{JoinHandle, LocalSet};
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::{error, warn};

use super::disk::Writer;
use super::display::{Display, REDRAW, advice};
use super::duplicate::Incarnation;
use super::events::Event;
use super::metrics::Metrics;
use super::network::{Connected, OpeningSession, Wire, connect};
use super::threads::{STUCK, Threads};
use crate::children::LocalEvaluators;
use crate::service::{End, Input, Order};
use crate::train::Outcome;

/// Time limit for closing the session, if the network hangs.
const CLOSE_PATIENCE: Duration = Duration::from_secs(5);
/// After this time a failed run gives up output that waits for the disk: the disk may be in
/// trouble, too.
const LAST_WRITES: Duration = Duration::from_secs(15);

#[derive(Debug)]
pub(crate) enum Ending {
    /// Training is complete, and every episode has a score or was given up.
    Complete,
    /// The user asked to stop, by a signal.
    Interrupted,
    /// Training is complete, but no evaluator came that may have the run's environment.
    Unscored,
    Failed(anyhow::Error),
}

pub(crate) struct MainLoop {
    pub incarnation: Incarnation,
    pub run_dir: RunDir,
    pub metrics: Metrics,
    /// The address of `/metrics`.
    pub metrics_address: String,
    /// The endpoints of the command line.
    pub endpoints: Endpoints,
    pub events: UnboundedReceiver<Event>,
    pub threads: Threads,
    pub display: Display,
    pub health: Health,
    /// Reports that this loop is alive. It is not if a full pipe blocks its output.
    pub beat: Heartbeat,
    pub evaluators: LocalEvaluators,
    /// The environment in which evaluators run the policies.
    pub environment: String,
}

/// The state of the run, as far as the loop knows.
#[derive(Default)]
struct State {
    trained: bool,
    interrupted: bool,
    wire: Option<Wire>,
    /// Endpoints for evaluators; empty until the run is connected.
    reachable_at: Vec<String>,
    /// Threads whose disk hangs, as reported.
    hanging: Vec<Writer>,
    /// Seconds that training has waited for experience.
    waited: f64,
}

impl MainLoop {
    /// Runs until the end, then ends the threads and the session. Call it on the main thread: the
    /// evaluators end with it.
    pub async fn run(mut self, opening: OpeningSession) -> Ending {
        let mut connecting = tokio::spawn(connect(
            opening,
            self.endpoints.clone(),
            self.incarnation.clone(),
            self.threads.services.clone(),
            self.run_dir.clone(),
            self.metrics_address.clone(),
        ));
        // Its context is limited to what the evaluators need: in it Zenoh may not block the thread,
        // as it does when a session is dropped.
        let local = LocalSet::new();
        let mut state = State::default();
        let mut ending = local.run_until(self.watch(&mut connecting, &mut state)).await;
        self.display.finish();
        // Everything ends at the same time: after a signal there is little of it.
        let evaluators = local.run_until(self.evaluators.end());
        tokio::join!(end(self.threads, &ending), evaluators);
        while let Ok(event) = self.events.try_recv() {
            match (event, &ending) {
                // The reason of the failure is known already.
                (Event::Failed(_), Ending::Failed(_)) => {}
                (Event::Failed(error), _) => ending = Ending::Failed(error),
                (event, _) => report(event, &mut self.display),
            }
        }
        if let Some(wire) = state.wire {
            // An evaluator that misses this message notices the lost connection.
            timeout(CLOSE_PATIENCE, tokio::spawn(wire.close())).await.ok();
        }
        ending
    }

    async fn watch(
        &mut self,
        connecting: &mut JoinHandle<anyhow::Result<Connected>>,
        state: &mut State,
    ) -> Ending {
        let mut shutdown = std::pin::pin!(shutdown_signal(LEAVE_WITHIN));
        let mut ticker = interval(REDRAW);
        ticker.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let mut is_connected = false;
        loop {
            tokio::select! {
                result = &mut *connecting, if !is_connected => {
                    is_connected = true;
                    let connected = result.map_err(anyhow::Error::from).flatten();
                    if let Err(error) = connected.and_then(|connected| self.connected(connected, state)) {
                        return Ending::Failed(error);
                    }
                }
                Some(event) = self.events.recv() => match event {
                    Event::Failed(error) => return Ending::Failed(error),
                    Event::TrainingEnded(Outcome::Stopped) => return Ending::Interrupted,
                    // The stop came during the last step; the run does not wait for scores.
                    Event::TrainingEnded(_) if state.interrupted => return Ending::Interrupted,
                    Event::TrainingEnded(Outcome::Completed) => {
                        state.trained = true;
                        self.threads.carrier().carry(Input::Trained);
                    }
                    event => report(event, &mut self.display),
                },
                _ = ticker.tick() => {
                    match self.tick(state) {
                        Some(End::Complete) => return Ending::Complete,
                        Some(End::Unscored) => return Ending::Unscored,
                        Some(End::OtherWeights(error)) => return Ending::Failed(error.into()),
                        None => {}
                    }
                }
                () = &mut shutdown, if !state.interrupted => {
                    state.interrupted = true;
                    if state.trained {
                        return Ending::Interrupted;
                    }
                    self.display.line("stopping after this gradient step");
                    self.threads.stop_training();
                }
            }
        }
    }

    fn connected(&mut self, connected: Connected, state: &mut State) -> anyhow::Result<()> {
        let (run, zenoh) = (&self.incarnation.run, connected.reachable_at.join(", "));
        let metrics = &self.metrics_address;
        self.display
            .line(&format!("run {run} is at {zenoh}, its metrics at http://{metrics}/metrics"));
        state.reachable_at = connected.reachable_at;
        state.wire = Some(connected.wire);
        let events = self.threads.carrier().events.clone();
        let report = move |line| events.line(line);
        self.evaluators.start(&state.reachable_at, self.run_dir.path(), run.as_str(), report)
    }

    fn tick(&mut self, state: &mut State) -> Option<End> {
        self.beat.alive();
        self.watch_disk(&mut state.hanging);
        self.display.tick();
        let waited = self.metrics.online.wait_seconds.get();
        let training_waits = mem::replace(&mut state.waited, waited) < waited;
        for order in self.threads.carrier().tick(training_waits) {
            match order {
                Order::Advise => self.display.line(&self.advice(state)),
                Order::End(end) => return Some(end),
                _ => {}
            }
        }
        None
    }

    fn advice(&self, state: &State) -> String {
        match state.reachable_at.first() {
            None => format!(
                "no router has answered at {} yet; {} for it",
                self.endpoints.connect.join(", "),
                if state.trained { "the scores wait" } else { "online episodes wait" }
            ),
            Some(endpoint) => advice(&self.environment, endpoint, self.evaluators.log()),
        }
    }

    /// A thread that writes and has not reported for long waits for the disk.
    fn watch_disk(&self, reported: &mut Vec<Writer>) {
        let mut hanging = Vec::from(Writer::ALL);
        hanging.retain(|writer| self.health.is_silent(writer.thread));
        for writer in hanging.iter().filter(|writer| !reported.contains(writer)) {
            self.metrics.disk_trouble(*writer).set(1);
            let (silent, waits) = (STUCK.as_secs(), writer.waits);
            self.display.line(&format!(
                "nothing was saved for {silent} s, as the disk hangs or the machine is too busy: {waits}"
            ));
        }
        *reported = hanging;
    }
}

fn report(event: Event, display: &mut Display) {
    match event {
        Event::Line(line) => display.line(&line),
        Event::Published { step } => {
            display.line(&format!("step {step}: snapshot handed to evaluation"));
        }
        Event::Evaluated { step, scores } => {
            let scores = Vec::from_iter(scores.iter().map(|score| score.score));
            let Some(Spread { mean, std, .. }) = Spread::new(&scores) else { return };
            display.scored(step, mean);
            let std = std.map(|std| format!(" ± {std:.2}")).unwrap_or_default();
            let episodes = counted(scores.len(), "episode");
            display.line(&format!("step {step}: score {mean:.2}{std} over {episodes}"));
        }
        Event::TrainingEnded(_) | Event::Failed(_) => {}
    }
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
