//! An evaluator's side of one run: jobs claimed, results owed, the learner process followed.

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_protocol::{Job, JobReply, Name, PieceReply, ScoreReply, ScoreReport, Snapshot, keys};
use rand::Rng;
use tokio::time::timeout_at;
use tracing::{debug, info, warn};
use zenoh::Wait;
use zenoh::liveliness::LivelinessToken;

use super::connection::{ANSWER_TIMEOUT, Connection};
use super::delivery::{Owed, Parcel};
use super::discovery::{Found, RunKey};
use super::query::{QueryError, blocking};
use super::scheduler::Turn;
use super::snapshot::{Listener, Snapshots};
use crate::metrics::Metrics;

/// Shortest and longest pause that a learner without work may ask for.
const PAUSE: [Duration; 2] = [Duration::from_millis(20), Duration::from_secs(60)];
/// Time that a leaving evaluator has to deliver its scores; half of it to hand a job back.
const LEAVE: Duration = Duration::from_secs(2);
/// Time that a leaving evaluator has to deliver an episode of practice, which has many pieces.
const LEAVE_EPISODE: Duration = Duration::from_secs(6);
/// Pause of a leaving evaluator after a learner's error.
const RETRY: Duration = Duration::from_millis(100);
/// Most jobs whose scores are kept for a step that the learner is to train to again.
const MOST_EARLY: usize = 64;
/// Most characters of a reason that the evaluator sends; the learner accepts no large messages.
const MAX_REASON_LEN: usize = 1000;

/// A claimed job, until the learner has acknowledged its results or its return. Meanwhile the
/// evaluator claims no other.
struct Claimed {
    job: Job,
    /// Results to deliver; without, the job goes back.
    owed: Option<Owed>,
    /// Reason of the return, for people.
    failed: Option<String>,
}

pub struct RunClient {
    key: RunKey,
    pub connection: Connection,
    snapshots: Snapshots,
    listener: Listener,
    /// Number of the claim that has no answer yet.
    attempt: Option<u64>,
    claimed: Option<Claimed>,
    /// Jobs whose scores the learner takes when it has trained to their step again.
    early: VecDeque<Claimed>,
    pub turn: Turn,
    /// Time of the learner's disappearance.
    pub gone: Option<Instant>,
    last_warning: String,
    _token: LivelinessToken,
}

impl RunClient {
    /// Subscribes to the run's snapshots and announces the evaluator in the run.
    pub async fn attach(
        key: RunKey,
        found: &Found,
        evaluator: Name,
        snapshots: Snapshots,
        metrics: Metrics,
    ) -> anyhow::Result<RunClient> {
        let (session, run) = (found.session.clone(), key.1.clone());
        let listener =
            Listener::start(&session, key.clone(), snapshots.clone(), metrics.clone()).await;
        let listener =
            listener.with_context(|| format!("cannot listen to the snapshots of run {run}"))?;
        let (declarer, live) = (session.clone(), keys::live_evaluator(&run, &evaluator));
        let token = blocking(move || declarer.liveliness().declare_token(live).wait()).await;
        let _token =
            token.with_context(|| format!("cannot announce this evaluator in run {run}"))?;
        let mut client = RunClient {
            key,
            connection: Connection { run, evaluator, session, metrics, incarnation: 0 },
            snapshots,
            listener,
            attempt: None,
            claimed: None,
            early: VecDeque::new(),
            turn: Turn::new(Instant::now()),
            gone: None,
            last_warning: String::new(),
            _token,
        };
        client.follow(&found.incarnations);
        Ok(client)
    }

    /// Follows the learner process that it follows already or, if that is gone, the oldest one: of
    /// two learners of one name, the later one stops.
    pub fn follow(&mut self, incarnations: &BTreeSet<u64>) {
        if self.gone.take().is_some() {
            self.turn = Turn::new(Instant::now());
        }
        if let Some(&first) = incarnations.first()
            && !incarnations.contains(&self.connection.incarnation)
        {
            self.switch_to(first);
        }
    }

    /// Follows the next of several processes, because this one does not answer.
    pub fn follow_next(&mut self, incarnations: &BTreeSet<u64>) {
        let current = self.connection.incarnation;
        let later = incarnations.range(current.saturating_add(1)..).next();
        if let Some(&next) = later.or(incarnations.first())
            && next != current
        {
            self.switch_to(next);
        }
    }

    fn switch_to(&mut self, incarnation: u64) {
        debug!(run = %self.connection.run, incarnation, "following a learner");
        self.connection.incarnation = incarnation;
        self.listener.follow(incarnation);
        self.turn = Turn::new(Instant::now());
    }

    /// Makes the run due if its learner has published a snapshot.
    pub fn wake_for_snapshot(&mut self) {
        if self.listener.take_news() {
            self.turn.nudge(Instant::now());
        }
    }

    /// Pauses this run, longer each time. Logs the error, but not the same one twice in a row.
    pub fn back_off(&mut self, error: &anyhow::Error) {
        let warning = format!("{error:#}");
        match self.last_warning == warning {
            false => warn!(run = %self.connection.run, "{warning}"),
            true => debug!(run = %self.connection.run, "{warning}"),
        }
        self.last_warning = warning;
        self.turn.failed(Instant::now());
    }

    /// Claims a job in one of these environments; `None` if there is none now.
    pub async fn claim(&mut self, environments: Vec<String>) -> anyhow::Result<Option<Job>> {
        let attempt = *self.attempt.get_or_insert_with(|| rand::rng().random());
        let reply = self.connection.claim(attempt, environments).await?;
        self.attempt = None;
        Ok(match reply {
            JobReply::Job(job) => {
                self.claimed = Some(Claimed { job: job.clone(), owed: None, failed: None });
                Some(job)
            }
            JobReply::Wait { milliseconds, .. } => {
                self.last_warning.clear();
                let pause = Duration::from_millis(milliseconds).clamp(PAUSE[0], PAUSE[1]);
                // Spreads out evaluators that a snapshot has woken together.
                let pause = pause.mul_f64(rand::random_range(0.5..1.0));
                self.turn = Turn::new(Instant::now() + pause);
                None
            }
            JobReply::HandedBack { .. } => None,
        })
    }

    /// The snapshot that `job` names: the published one or, if the evaluator missed it, a requested
    /// one.
    pub async fn snapshot(&self, job: &Job) -> anyhow::Result<Arc<Snapshot>> {
        match self.snapshots.get(&self.key, job) {
            Some(snapshot) => Ok(snapshot),
            None => Ok(Arc::new(self.connection.snapshot(job).await?)),
        }
    }

    pub fn has_job(&self) -> bool {
        self.claimed.is_some()
    }

    /// True if there are results to deliver, or a job to hand back.
    pub fn owes(&self) -> bool {
        self.has_job() || !self.early.is_empty()
    }

    /// Keeps the results of the claimed job for delivery.
    pub fn keep(&mut self, owed: Owed) {
        if let Some(claimed) = &mut self.claimed {
            claimed.owed = Some(owed);
        }
    }

    fn owed(&self) -> Option<&Owed> {
        self.claimed.as_ref()?.owed.as_ref()
    }

    /// Delivers the kept results, or hands a failed job back. Keeps after an error what is not
    /// acknowledged.
    pub async fn deliver(&mut self, timeout: Duration) -> Result<(), QueryError> {
        let connection = &self.connection;
        let Some(Claimed { job, owed: Some(owed), .. }) = &mut self.claimed else {
            return self.hand_back(timeout).await;
        };
        let (run, step) = (&connection.run, job.step);
        let answer = match owed {
            Owed::Scores(report) => deliver_scores(connection, report, timeout).await?,
            Owed::Episode(parcel) => deliver_episode(connection, step, parcel, timeout).await?,
        };
        if let Answer::Refused(refused) = answer {
            warn!(%run, step, "the learner {refused}");
            connection.metrics.job("abandoned");
            self.return_job(Some(format!("it {refused}")));
            return self.hand_back(timeout).await;
        }
        let claimed = self.claimed.take();
        if let Answer::NotYet = answer {
            debug!(%run, step, "the scores wait until the learner has trained to that step again");
            self.early.extend(claimed);
            if self.early.len() > MOST_EARLY {
                self.early.pop_front();
                connection.metrics.job("abandoned");
            }
        }
        self.last_warning.clear();
        self.turn = Turn::new(Instant::now());
        Ok(())
    }

    /// Takes up a job again whose scores came too early. False if there is none.
    pub fn take_early(&mut self) -> bool {
        self.claimed = self.early.pop_front();
        self.has_job()
    }

    /// True if this evaluator has scores of the evaluation that `job` is a part of.
    pub fn has_scores_like(&self, job: &Job) -> bool {
        let early = |kept: &Claimed| (kept.job.step, kept.job.weights) == (job.step, job.weights);
        job.practice.is_none() && self.early.iter().any(early)
    }

    /// Hands back the claimed job, which this evaluator could not run; if there is no answer,
    /// [`deliver`](Self::deliver) tries again.
    pub async fn fail(&mut self, reason: &str) {
        self.connection.metrics.job("failed");
        self.return_job(Some(reason.chars().take(MAX_REASON_LEN).collect()));
        if let Err(error) = self.hand_back(ANSWER_TIMEOUT).await {
            debug!(run = %self.connection.run, "{error}");
        }
    }

    /// Delivers the results, or hands the job back, before this evaluator ends.
    pub async fn leave(mut self) {
        let is_episode = matches!(self.owed(), Some(Owed::Episode(_)));
        let until = Instant::now() + if is_episode { LEAVE_EPISODE } else { LEAVE };
        let mut answered = false;
        while self.owed().is_some() {
            let delivered = timeout_at(until.into(), self.deliver(LEAVE / 2)).await;
            let run = &self.connection.run;
            let late = |_| Err(QueryError::NoAnswer(keys::experience(run)));
            let Err(error) = delivered.unwrap_or_else(late) else { return };
            // A learner that answers with an error has received the scores and may still save them.
            // If the job went back now, others would run it again. An episode of a robot or a person
            // cannot be run again.
            let unusable = matches!(error, QueryError::Unusable { .. });
            answered |= unusable && !is_episode;
            if !(unusable || is_episode) || Instant::now() + RETRY > until {
                warn!(%run, "the learner has not acknowledged the results: {error}");
                break;
            }
            tokio::time::sleep(RETRY).await;
        }
        if !answered {
            self.return_job(None);
            while self.hand_back(LEAVE / 2).await.is_err() && Instant::now() + RETRY < until {
                tokio::time::sleep(RETRY).await;
            }
        }
    }

    /// Drops the results, if any, so that the job goes back.
    fn return_job(&mut self, reason: Option<String>) {
        if let Some(claimed) = &mut self.claimed {
            claimed.owed = None;
            claimed.failed = reason.or(claimed.failed.take());
        }
    }

    async fn hand_back(&mut self, timeout: Duration) -> Result<(), QueryError> {
        let Some(claimed) = &self.claimed else { return Ok(()) };
        let (incarnation, failed) = (claimed.job.incarnation, claimed.failed.clone());
        let returned = self.connection.hand_back(claimed.job.id, incarnation, failed, timeout);
        match returned.await {
            Ok(true) => info!(run = %self.connection.run, "a job was handed back"),
            // If another process is followed by now, the one that gave the job may be gone.
            Err(error) if incarnation == self.connection.incarnation => return Err(error),
            Ok(false) | Err(_) => {}
        }
        self.claimed = None;
        Ok(())
    }

    /// Stops serving the run, and drops results that were not acknowledged.
    pub fn give_up(self) {
        let Connection { run, metrics, .. } = &self.connection;
        self.snapshots.forget(&self.key);
        let claimed = self.claimed.filter(|claimed| claimed.owed.is_some());
        for Claimed { job, .. } in claimed.into_iter().chain(self.early) {
            warn!(%run, step = job.step, "the learner did not return; its results are dropped");
            metrics.job("abandoned");
        }
    }
}

/// A learner's last word on results.
enum Answer {
    Recorded,
    NotYet,
    /// With the reason.
    Refused(String),
}

async fn deliver_scores(
    connection: &Connection,
    report: &ScoreReport,
    timeout: Duration,
) -> Result<Answer, QueryError> {
    let Connection { run, metrics, .. } = connection;
    let delivered = connection.deliver(keys::scores(run), report, timeout, ScoreReply::incarnation);
    Ok(match delivered.await? {
        ScoreReply::Recorded { new, duplicates, .. } => {
            let scores = report.episodes.iter().map(|episode| episode.score);
            let mean = scores.clone().sum::<f64>() / report.episodes.len().max(1) as f64;
            scores.for_each(|score| metrics.episode_score.observe(score));
            let step = report.step;
            info!(%run, step, new, duplicates, "scores delivered, mean {mean:.2}");
            metrics.job("scored");
            Answer::Recorded
        }
        ScoreReply::NotYet { .. } => Answer::NotYet,
        ScoreReply::Refused { reason, .. } => {
            Answer::Refused(format!("refused the scores: {reason}"))
        }
    })
}

/// Delivers an episode in pieces.
async fn deliver_episode(
    connection: &Connection,
    step: u64,
    parcel: &mut Parcel,
    timeout: Duration,
) -> Result<Answer, QueryError> {
    let (Connection { run, metrics, .. }, seed) = (connection, parcel.seed());
    loop {
        let (key, piece) = (keys::experience(run), parcel.piece());
        match connection.deliver(key, &piece, timeout, PieceReply::incarnation).await? {
            PieceReply::Continue { offset, .. } => {
                let unusable = |reason| QueryError::Unusable { key: keys::experience(run), reason };
                parcel.continue_at(offset).map_err(unusable)?;
            }
            PieceReply::Recorded { duplicate, .. } => {
                let rows = parcel.rows;
                info!(%run, step, seed, rows, duplicate, "an episode of practice delivered");
                metrics.practice_rows.inc_by(rows);
                metrics.job("practiced");
                return Ok(Answer::Recorded);
            }
            PieceReply::Refused { reason, .. } => {
                let refused = format!("refused the episode with seed {seed}: {reason}");
                return Ok(Answer::Refused(refused));
            }
        }
    }
}
