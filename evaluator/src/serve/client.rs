//! All communication with the learner of one run: jobs, snapshots, progress; `delivery` has scores
//! and jobs that go back.

mod delivery;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_protocol::{Job, JobReply, JobRequest, Name, Progress, Snapshot, encode, keys};
use rand::Rng;
use tracing::{debug, warn};
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

use super::discovery::Found;
use super::query::{ask, may_block};
use super::scheduler::Turn;
use super::snapshot::{Listener, Snapshots, is_named_by};
use crate::metrics::Metrics;
use delivery::Owed;

/// A learner answers in milliseconds; for one that hangs or is very busy, other runs do not wait
/// longer than this.
pub const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Patience with a learner that sends a snapshot, which has megabytes.
const WEIGHTS_TIMEOUT: Duration = Duration::from_secs(30);
/// Limits of the pause that a learner without work may ask for: the learner gets no flood of
/// queries, and loses no evaluator.
const PAUSE: [Duration; 2] = [Duration::from_millis(20), Duration::from_secs(60)];

/// An evaluator's side of one run.
pub struct RunClient {
    run: Name,
    evaluator: Name,
    session: Session,
    metrics: Metrics,
    snapshots: Snapshots,
    listener: Listener,
    /// The process of the learner that this evaluator follows. It ignores answers of others.
    incarnation: u64,
    /// The number of the claim that has no answer yet.
    attempt: Option<u64>,
    owed: Option<Owed>,
    /// When the run is due next.
    pub turn: Turn,
    /// When the learner disappeared.
    pub gone: Option<Instant>,
    /// The last warning, so that it is not repeated.
    complaint: String,
    _token: LivelinessToken,
}

impl RunClient {
    /// Subscribes to the run's snapshots and announces the evaluator in the run.
    pub async fn attach(
        run: Name,
        found: &Found,
        evaluator: Name,
        snapshots: Snapshots,
        metrics: Metrics,
    ) -> anyhow::Result<RunClient> {
        let session = found.session.clone();
        let listener =
            Listener::start(&session, run.clone(), snapshots.clone(), metrics.clone()).await;
        let listener =
            listener.with_context(|| format!("cannot listen to the snapshots of run {run}"))?;
        let (declared, key) = (session.clone(), keys::live_evaluator(&run, &evaluator));
        let token = may_block(move || declared.liveliness().declare_token(key).wait()).await;
        let token =
            token.with_context(|| format!("cannot announce this evaluator in run {run}"))?;
        let mut client = RunClient {
            run,
            evaluator,
            session,
            metrics,
            snapshots,
            listener,
            incarnation: 0,
            attempt: None,
            owed: None,
            turn: Turn::new(Instant::now()),
            gone: None,
            complaint: String::new(),
            _token: token,
        };
        client.follow(&found.incarnations);
        Ok(client)
    }

    /// Chooses which of these processes of a learner to follow: the one that it follows already,
    /// else the one that started first, because of two learners of one name the later one stops.
    pub fn follow(&mut self, incarnations: &BTreeSet<u64>) {
        if self.gone.take().is_some() {
            self.turn.wake(Instant::now());
        }
        if let Some(&first) = incarnations.first()
            && !incarnations.contains(&self.incarnation)
        {
            self.turn_to(first);
        }
    }

    /// Follows the next of several processes, because this one does not answer.
    pub fn follow_next(&mut self, incarnations: &BTreeSet<u64>) {
        let next = incarnations
            .range(self.incarnation.saturating_add(1)..)
            .next()
            .or(incarnations.first());
        if let Some(&next) = next.filter(|next| **next != self.incarnation) {
            self.turn_to(next);
        }
    }

    fn turn_to(&mut self, incarnation: u64) {
        debug!(run = %self.run, incarnation, "following a learner");
        self.incarnation = incarnation;
        self.listener.follow(incarnation);
        self.turn.wake(Instant::now());
    }

    /// Makes the run due if its learner has published a snapshot.
    pub fn wake_for_snapshot(&mut self) {
        if self.listener.take_news() {
            self.turn.nudge(Instant::now());
        }
    }

    /// Pauses this run, longer each time. Logs why, unless the reason is the same as the last time.
    pub fn back_off(&mut self, error: &anyhow::Error) {
        let complaint = format!("{error:#}");
        match self.complaint == complaint {
            false => warn!(run = %self.run, "{complaint}"),
            true => debug!(run = %self.run, "{complaint}"),
        }
        self.complaint = complaint;
        self.turn.failed(Instant::now());
    }

    /// Claims a job in one of these environments; `None` if there is none now.
    pub async fn claim(&mut self, environments: Vec<String>) -> anyhow::Result<Option<Job>> {
        // The same number until there is an answer: if only the answer was lost, the learner
        // repeats the job.
        let attempt = *self.attempt.get_or_insert_with(|| rand::rng().random());
        let request = encode(&JobRequest::Claim {
            evaluator: self.evaluator.clone(),
            attempt,
            environments,
        })?;
        let (run, incarnation) = (self.run.clone(), self.incarnation);
        let fitting = move |reply: &JobReply| match reply {
            JobReply::Job(job) if job.run != run => Err("other_run"),
            JobReply::HandedBack { .. } => Err("unexpected"),
            _ => is_from(incarnation, reply.incarnation()),
        };
        let key = keys::jobs(&self.run);
        let answer =
            ask(&self.session, key, request, ANSWER_TIMEOUT, &self.metrics, fitting).await?;
        self.attempt = None;
        match answer {
            JobReply::Job(job) => {
                self.owed =
                    Some(Owed::Job { id: job.id, incarnation: job.incarnation, failed: None });
                Ok(Some(job))
            }
            JobReply::Wait { milliseconds, .. } => {
                self.complaint.clear();
                let pause = Duration::from_millis(milliseconds).clamp(PAUSE[0], PAUSE[1]);
                // Spreads out evaluators that a snapshot has woken together.
                self.turn.done(Instant::now(), pause.mul_f64(rand::random_range(0.5..1.0)));
                Ok(None)
            }
            JobReply::HandedBack { .. } => Ok(None),
        }
    }

    /// The snapshot that `job` names: the published one, or a requested one if the evaluator missed
    /// the publication.
    pub async fn snapshot(&self, job: &Job) -> anyhow::Result<Arc<Snapshot>> {
        if let Some(snapshot) = self.snapshots.get(job) {
            return Ok(snapshot);
        }
        let (key, wanted) = (keys::weights_at(&self.run, job.step), job.clone());
        let fitting = move |found: &Snapshot| {
            is_named_by(&wanted, found).then_some(()).ok_or("other_snapshot")
        };
        let snapshot: Snapshot =
            ask(&self.session, key, Vec::new(), WEIGHTS_TIMEOUT, &self.metrics, fitting).await?;
        self.metrics.snapshots_received.inc();
        Ok(Arc::new(snapshot))
    }

    /// Reports the progress of `job`. A lost message does no harm, because the next one contains
    /// its news. So Zenoh drops the message if the connection is full, and this call does not wait.
    pub fn tell(&self, job: &Job, steps_done: u64, episodes_done: u32) {
        let progress = Progress {
            steps_done,
            episodes_done,
            environment_steps: self.metrics.environment_steps.get(),
            episodes: self.metrics.episodes.get(),
            ..Progress::of(job, self.evaluator.clone())
        };
        let Ok(message) = encode(&progress) else { return };
        let put = self.session.put(keys::progress(&self.run, &self.evaluator), message);
        if let Err(error) = put.congestion_control(CongestionControl::Drop).wait() {
            debug!(run = %self.run, "cannot publish progress: {error}");
        }
    }
}

/// Whether a reply is from the followed learner; if not, the label of the reason.
fn is_from(followed: u64, incarnation: u64) -> Result<(), &'static str> {
    if incarnation == followed { Ok(()) } else { Err("other_incarnation") }
}
