//! Everything that is exchanged with the learner of one run: jobs, snapshots, progress, scores.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_protocol::{Job, JobReply, JobRequest, Name, Progress, ScoreReply, ScoreReport, Snapshot, encode, keys};
use tokio::sync::Notify;
use tracing::{info, warn};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;

use super::query::{AskError, ask};
use super::receiver::SnapshotReceiver;
use crate::metrics::{JobOutcome, Metrics};

/// A learner answers in milliseconds; one that takes this long hangs, and other runs wait behind it.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// The same for a snapshot, which has megabytes to carry over whatever network there is.
const WEIGHTS_TIMEOUT: Duration = Duration::from_secs(30);
/// First and longest pause after a learner did not answer though it is connected.
const BACK_OFF: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];
/// Bounds of the pause that a learner without work may ask for: one too short would be a flood of questions, one too
/// long would lose the evaluator.
const WAIT: [Duration; 2] = [Duration::from_millis(20), Duration::from_secs(5)];

/// An evaluator's side of one run.
pub struct RunClient {
    run: Name,
    evaluator: Name,
    session: Session,
    metrics: Metrics,
    snapshots: SnapshotReceiver,
    /// Scores that the learner has not acknowledged. While there are some, nothing new is asked for.
    undelivered: Option<ScoreReport>,
    ready_at: Instant,
    back_off: Duration,
    _token: LivelinessToken,
}

impl RunClient {
    /// Subscribes to the run's snapshots and announces `evaluator` in it; `snapshot_arrived` is told of each new one.
    pub async fn attach(
        session: Session,
        run: Name,
        evaluator: Name,
        metrics: Metrics,
        snapshot_arrived: Arc<Notify>,
    ) -> anyhow::Result<RunClient> {
        let readable = |error: zenoh::Error| anyhow::anyhow!(error);
        let snapshots = SnapshotReceiver::listen(&session, run.clone(), metrics.clone(), snapshot_arrived)
            .await
            .map_err(readable)
            .with_context(|| format!("cannot listen to the snapshots of run {run}"))?;
        let token = session
            .liveliness()
            .declare_token(keys::live_evaluator(&run, &evaluator))
            .await
            .map_err(readable)
            .with_context(|| format!("cannot announce this evaluator in run {run}"))?;
        let (ready_at, back_off) = (Instant::now(), BACK_OFF[0]);
        Ok(RunClient {
            run,
            evaluator,
            session,
            metrics,
            snapshots,
            undelivered: None,
            ready_at,
            back_off,
            _token: token,
        })
    }

    /// When the learner may be asked again.
    pub fn ready_at(&self) -> Instant {
        self.ready_at
    }

    /// Lets the learner be asked again at once, because something has changed.
    pub fn wake(&mut self) {
        self.ready_at = Instant::now();
        self.back_off = BACK_OFF[0];
    }

    /// Asks the learner nothing for a while, which is longer each time.
    pub fn back_off(&mut self) {
        self.ready_at = Instant::now() + self.back_off;
        self.back_off = (2 * self.back_off).min(BACK_OFF[1]);
    }

    /// Whether scores wait for an acknowledgement.
    pub fn has_undelivered(&self) -> bool {
        self.undelivered.is_some()
    }

    /// Asks for a job; `None` when there is none now, or nobody to ask.
    pub async fn claim(&mut self, environments: Vec<String>) -> anyhow::Result<Option<Job>> {
        let request = encode(&JobRequest { evaluator: self.evaluator.clone(), environments })?;
        let answer = ask(&self.session, keys::jobs(&self.run), request, ANSWER_TIMEOUT, &self.metrics).await?;
        self.back_off = BACK_OFF[0];
        match answer {
            JobReply::Job(job) => Ok(Some(job)),
            JobReply::Wait { milliseconds } => {
                let wait = Duration::from_millis(milliseconds).clamp(WAIT[0], WAIT[1]);
                self.ready_at = Instant::now() + wait;
                Ok(None)
            }
        }
    }

    /// The snapshot that `job` names: as it was published, or asked for where that was missed.
    pub async fn snapshot(&self, job: &Job) -> Result<Arc<Snapshot>, AskError> {
        if let Some(snapshot) = self.snapshots.get(job) {
            return Ok(snapshot);
        }
        let key = keys::weights_at(&self.run, job.step);
        let snapshot = ask::<Snapshot>(&self.session, key, Vec::new(), WEIGHTS_TIMEOUT, &self.metrics).await?;
        self.metrics.snapshots_received.inc();
        Ok(Arc::new(snapshot))
    }

    /// Reports progress to the learner. A lost message does not matter: the next one says the same and more.
    pub async fn publish(&self, progress: &Progress) {
        let key = keys::progress(&self.run, &self.evaluator);
        let sent = match encode(progress) {
            Ok(message) => self.session.put(&key, message).await.map_err(|error| error.to_string()),
            Err(error) => Err(error.to_string()),
        };
        if let Err(error) = sent {
            warn!(key, "cannot publish progress: {error}");
        }
    }

    /// Keeps scores until the learner has them.
    pub fn keep(&mut self, report: ScoreReport) {
        self.undelivered = Some(report);
    }

    /// Delivers the scores that are kept. An error means that they are still kept.
    pub async fn deliver(&mut self) -> anyhow::Result<()> {
        let Some(report) = &self.undelivered else { return Ok(()) };
        let answer: ScoreReply =
            ask(&self.session, keys::scores(&self.run), encode(report)?, ANSWER_TIMEOUT, &self.metrics).await?;
        let (run, step) = (&self.run, report.step);
        match answer {
            ScoreReply::Recorded { .. } if report.cannot_act.is_some() => {}
            ScoreReply::Recorded { new, duplicates } => {
                let scores = report.episodes.iter().map(|episode| episode.score);
                let mean = scores.clone().sum::<f64>() / report.episodes.len().max(1) as f64;
                info!(%run, step, new, duplicates, "scores delivered, mean {mean:.2}");
                scores.for_each(|score| self.metrics.episode_score.observe(score));
                self.metrics.job(JobOutcome::Scored);
            }
            ScoreReply::Refused { reason } => {
                warn!(%run, step, "the learner refused the scores: {reason}");
                self.metrics.job(JobOutcome::Abandoned);
            }
        }
        self.undelivered = None;
        self.back_off = BACK_OFF[0];
        Ok(())
    }

    /// Stops serving the run; scores that were not acknowledged are lost.
    pub fn give_up(self) {
        if let Some(report) = self.undelivered {
            warn!(run = %self.run, step = report.step, "the learner did not come back for its scores");
            self.metrics.job(JobOutcome::Abandoned);
        }
    }
}
