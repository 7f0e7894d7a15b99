//! Finds the runs: every learner announces its run with a liveliness token.

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_protocol::{Name, keys};
use quad_service::{Certificates, Endpoints, open_session};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::{debug, info, warn};
use zenoh::Session;
use zenoh::query::Reply;
use zenoh::sample::{Sample, SampleKind};

use crate::metrics::Metrics;

/// Most runs that are served at a time, and most learners of one run that are told apart: for floods of made-up ones.
const MOST_RUNS: usize = 256;
const MOST_LIVES: usize = 8;
/// Where there is no room, a run that has come to nothing for this long gives its place to another one.
const CHANCE: Duration = Duration::from_secs(30);
/// A run that there was no room for is looked for again after this long.
const LOOK_AGAIN: Duration = Duration::from_secs(10);
/// The label of a key that names no learner.
const INVALID: &str = "invalid_name";

/// A run as one endpoint shows it: the endpoint's place on the command line, and the run's name.
///
/// Seen through two endpoints, a run is served through both: either may fail on its own.
pub type RunKey = (usize, Name);

/// A run whose learner is there.
#[derive(Clone)]
pub struct Found {
    /// The session that reaches it.
    pub session: Session,
    /// The incarnations that announce themselves, at least one: a learner that was cut off or killed may still seem to be
    /// there when the next one starts.
    pub lives: BTreeSet<u64>,
    /// Since when it is served.
    pub since: Instant,
    /// Whether its learner has ever accepted scores.
    pub proven: Arc<AtomicBool>,
}

/// The runs that are there.
pub type Runs = BTreeMap<RunKey, Found>;

/// Watches every endpoint for as long as it lives.
pub struct Discovery {
    runs: watch::Receiver<Runs>,
    tasks: JoinSet<anyhow::Result<Infallible>>,
}

impl Discovery {
    /// Starts to watch; endpoints that nobody listens at yet are waited for.
    ///
    /// Each endpoint gets a session of its own, because a Zenoh client keeps one connection: with one session,
    /// a second learner's endpoint would only be a spare for the first.
    pub fn start(endpoints: Vec<String>, certificates: Option<&Certificates>, metrics: &Metrics) -> Discovery {
        let (found, runs) = watch::channel(Runs::new());
        let mut tasks = JoinSet::new();
        for (index, endpoint) in endpoints.into_iter().enumerate() {
            tasks.spawn(watch_endpoint(index, endpoint, certificates.cloned(), found.clone(), metrics.clone()));
        }
        Discovery { runs, tasks }
    }

    /// The runs that are there, as they come and go.
    pub fn runs(&self) -> watch::Receiver<Runs> {
        self.runs.clone()
    }

    /// Waits until an endpoint cannot be watched any more, which only a wrong endpoint or a bug causes.
    pub async fn failed(&mut self) -> anyhow::Error {
        match self.tasks.join_next().await {
            Some(Ok(Err(error))) => error,
            Some(Err(error)) => anyhow::Error::new(error).context("the search for learners broke off"),
            Some(Ok(Ok(never))) => match never {},
            None => std::future::pending().await,
        }
    }
}

async fn watch_endpoint(
    index: usize,
    endpoint: String,
    certificates: Option<Certificates>,
    found: watch::Sender<Runs>,
    metrics: Metrics,
) -> anyhow::Result<Infallible> {
    info!(endpoint, "waiting for a learner or a router");
    let endpoints = Endpoints { connect: vec![endpoint.clone()], certificates, ..Endpoints::default() };
    let session = open_session(&endpoints).await?;
    info!(endpoint, "connected");
    let failed = || format!("cannot look for learners at {endpoint}");
    let watch = Arc::new(Watch {
        index,
        session: session.clone(),
        found,
        metrics,
        no_room: false.into(),
        warned: false.into(),
    });
    let told = watch.clone();
    let subscriber = session.liveliness().declare_subscriber(keys::ALL_LEARNERS).history(true);
    let subscriber = subscriber.callback(move |token| told.take_in(&token));
    let _subscriber = subscriber.await.map_err(|error| anyhow::anyhow!(error)).with_context(failed)?;
    loop {
        tokio::time::sleep(LOOK_AGAIN).await;
        anyhow::ensure!(!session.is_closed(), "the Zenoh session closed");
        if watch.no_room.swap(false, Relaxed) {
            let told = watch.clone();
            let answer = move |reply: Reply| {
                if let Ok(token) = reply.result() {
                    told.take_in(token);
                }
            };
            let looked = session.liveliness().get(keys::ALL_LEARNERS).callback(answer).await;
            looked.map_err(|error| anyhow::anyhow!(error)).with_context(failed)?;
        }
    }
}

/// What is done with the tokens of one endpoint.
struct Watch {
    index: usize,
    session: Session,
    found: watch::Sender<Runs>,
    metrics: Metrics,
    /// Somebody was turned away who could be served if another one went.
    no_room: AtomicBool,
    /// One line in the log for those who are turned away; all are counted.
    warned: AtomicBool,
}

impl Watch {
    fn take_in(&self, token: &Sample) {
        let (kind, key) = (token.kind(), token.key_expr().as_str());
        let mut problem = None;
        self.found.send_if_modified(|runs| {
            let followed = follow(runs, (self.index, &self.session), kind, key, Instant::now());
            // Whoever has given its place to another one is looked for as well.
            self.no_room.fetch_or(runs.len() >= MOST_RUNS, Relaxed);
            followed.unwrap_or_else(|label| {
                problem = Some(label);
                false
            })
        });
        let Some(label) = problem else { return };
        self.metrics.rejected(label);
        self.no_room.fetch_or(label != INVALID, Relaxed);
        match self.warned.swap(true, Relaxed) {
            false => warn!(key, label, "a learner is not served; more are only counted"),
            true => debug!(key, label, "a learner is not served"),
        }
    }
}

/// Makes room for another run, if one has come to nothing for long.
fn make_room(runs: &mut Runs, now: Instant) -> bool {
    let idle = runs.iter().filter(|(_, run)| !run.proven.load(Relaxed) && now - run.since >= CHANCE);
    let Some(place) = idle.min_by_key(|(_, run)| run.since).map(|(place, _)| place.clone()) else { return false };
    debug!(run = %place.1, "gives its place to another run");
    runs.remove(&place);
    true
}

/// Takes in a token; says whether the runs have changed, or why it is not taken in.
fn follow(
    runs: &mut Runs,
    (index, session): (usize, &Session),
    kind: SampleKind,
    key: &str,
    now: Instant,
) -> Result<bool, &'static str> {
    let (run, incarnation) = keys::run_of(key).zip(keys::incarnation_of(key)).ok_or(INVALID)?;
    let place = (index, run.clone());
    let new = kind == SampleKind::Put && !runs.contains_key(&place);
    if new && runs.len() >= MOST_RUNS && !make_room(runs, now) {
        return Err("too_many_runs");
    }
    match (kind, runs.get_mut(&place)) {
        (SampleKind::Put, None) => {
            info!(%run, incarnation, "found a run");
            let (session, lives) = (session.clone(), BTreeSet::from([incarnation]));
            runs.insert(place, Found { session, lives, since: now, proven: Arc::default() });
            Ok(true)
        }
        (SampleKind::Put, Some(found)) if found.lives.contains(&incarnation) => Ok(false),
        (SampleKind::Put, Some(found)) if found.lives.len() >= MOST_LIVES => Err("too_many_learners"),
        (SampleKind::Put, Some(found)) => Ok(found.lives.insert(incarnation)),
        (SampleKind::Delete, None) => Ok(false),
        (SampleKind::Delete, Some(found)) => {
            let changed = found.lives.remove(&incarnation);
            if found.lives.is_empty() {
                info!(%run, incarnation, "the run's learner is gone");
                runs.remove(&place);
            }
            Ok(changed)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(flavor = "multi_thread")]
    async fn so_many_runs_and_lives_are_followed_and_no_more() {
        let endpoints = Endpoints { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..Endpoints::default() };
        let session = open_session(&endpoints).await.unwrap();
        let mut runs = Runs::new();
        let start = Instant::now();
        let mut tell = |kind, run: usize, life: usize| {
            let key = format!("quad/run-{run}/live/learner/{life}");
            let result = follow(&mut runs, (0, &session), kind, &key, start);
            (result, runs.len())
        };
        for run in 0..MOST_RUNS {
            assert_eq!(tell(SampleKind::Put, run, 1), (Ok(true), run + 1));
        }
        assert_eq!(tell(SampleKind::Put, MOST_RUNS, 1), (Err("too_many_runs"), MOST_RUNS));
        for life in 2..=MOST_LIVES {
            assert_eq!(tell(SampleKind::Put, 0, life), (Ok(true), MOST_RUNS));
        }
        assert_eq!(tell(SampleKind::Put, 0, 99), (Err("too_many_learners"), MOST_RUNS));
        assert_eq!(tell(SampleKind::Put, 0, 1).0, Ok(false), "it is known");
        for life in 1..=MOST_LIVES {
            assert_eq!(tell(SampleKind::Delete, 0, life).0, Ok(true));
        }
        assert_eq!(tell(SampleKind::Delete, MOST_RUNS, 1), (Ok(false), MOST_RUNS - 1));
        assert_eq!(tell(SampleKind::Put, MOST_RUNS, 1), (Ok(true), MOST_RUNS), "there is room again");

        // Later, whoever has come to nothing gives way, and nobody else.
        runs.values().skip(3).for_each(|run| run.proven.store(true, Relaxed));
        let kept = Vec::from_iter(runs.keys().skip(3).cloned());
        let mut tell = |run: usize, seconds| {
            let (key, now) = (format!("quad/late-{run}/live/learner/1"), start + Duration::from_secs(seconds));
            follow(&mut runs, (0, &session), SampleKind::Put, &key, now)
        };
        assert_eq!(tell(0, CHANCE.as_secs() - 1), Err("too_many_runs"));
        assert_eq!([1, 2, 3, 4].map(|run| tell(run, CHANCE.as_secs()).is_ok()), [true, true, true, false]);
        assert!(kept.iter().all(|place| runs.contains_key(place)));
    }
}
