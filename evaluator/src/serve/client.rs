//! An evaluator's side of one run: it does what its duty says.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_protocol::{Job, JobReply, Name, PieceReply, ScoreReply, Snapshot, keys};
use tokio::time::timeout_at;
use tracing::{debug, info, warn};
use zenoh::Wait;
use zenoh::liveliness::LivelinessToken;

use super::connection::{ANSWER_TIMEOUT, Connection, QueryError, blocking};
use super::delivery::Owed;
use super::discovery::{Learners, RunKey};
use super::duty::{Duty, Note, Step};
use super::evaluate::Evaluator;
use super::snapshot::{Listener, Snapshots};
use crate::metrics::Metrics;

/// Time that a leaving evaluator has to deliver its scores; half of it to hand a job back.
const LEAVE: Duration = Duration::from_secs(2);
/// Time that a leaving evaluator has to deliver an online episode, which has many pieces.
const LEAVE_EPISODE: Duration = Duration::from_secs(6);
/// Pause of a leaving evaluator after a learner's error.
const RETRY: Duration = Duration::from_millis(100);

pub struct RunClient {
    key: RunKey,
    pub connection: Connection,
    snapshots: Snapshots,
    listener: Listener,
    pub duty: Duty,
    /// Time of the learner's disappearance.
    pub gone: Option<Instant>,
    last_warning: String,
    _token: LivelinessToken,
}

impl RunClient {
    /// Subscribes to the run's snapshots and announces the evaluator in the run.
    pub async fn attach(
        key: RunKey,
        learners: &Learners,
        evaluator: Name,
        snapshots: Snapshots,
        metrics: Metrics,
    ) -> anyhow::Result<RunClient> {
        let (session, run) = (learners.session.clone(), key.1.clone());
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
            duty: Duty::new(Instant::now()),
            gone: None,
            last_warning: String::new(),
            _token,
        };
        client.follow(&learners.incarnations);
        Ok(client)
    }

    /// Follows one of the run's learner processes, which are there.
    pub fn follow(&mut self, incarnations: &BTreeSet<u64>) {
        let now = Instant::now();
        if self.gone.take().is_some() {
            self.duty.is_back(now);
        }
        self.duty.follow(incarnations, now);
        self.listen();
    }

    /// Takes messages of the followed process from now on.
    fn listen(&mut self) {
        let incarnation = self.duty.incarnation();
        if incarnation != self.connection.incarnation {
            debug!(run = %self.connection.run, incarnation, "following a learner");
            self.connection.incarnation = incarnation;
            self.listener.follow(incarnation);
        }
    }

    /// Makes the run due if its learner has published a snapshot.
    pub fn wake_for_snapshot(&mut self) {
        if self.listener.take_news() {
            self.duty.nudge(Instant::now());
        }
    }

    /// Does a step of a turn.
    pub async fn take(&mut self, step: Step, evaluator: &mut Evaluator) -> Result<(), QueryError> {
        match step {
            Step::Claim { attempt } => {
                let environments = evaluator.environments.names();
                let reply = self.connection.claim(attempt, environments).await?;
                if let JobReply::Wait { .. } = reply {
                    self.last_warning.clear();
                }
                self.duty.claimed(reply, rand::random_range(0.5..1.0), Instant::now());
            }
            Step::Play(job) => match self.play(&job, evaluator).await {
                Ok(owed) => self.duty.played(Ok(owed)),
                Err(error) => {
                    self.connection.metrics.job("failed");
                    self.duty.played(Err(&format!("{error:#}")));
                    self.warn(&error.context(format!("a job of step {} failed", job.step)));
                }
            },
            step => self.deliver(step, ANSWER_TIMEOUT).await?,
        }
        Ok(())
    }

    async fn play(&self, job: &Job, evaluator: &mut Evaluator) -> anyhow::Result<Owed> {
        evaluator.evaluate(job, &self.connection, self.snapshot(job)).await
    }

    /// Ends a turn in which the learner has not answered: the run rests, and another of its
    /// processes is followed, if there is one.
    pub fn rest(&mut self, error: QueryError, incarnations: &BTreeSet<u64>) {
        self.warn(&error.into());
        self.duty.unanswered(Instant::now());
        self.duty.follow_next(incarnations, Instant::now());
        self.listen();
    }

    /// Delivers results, or hands a job back.
    async fn deliver(&mut self, step: Step, timeout: Duration) -> Result<(), QueryError> {
        let (run, connection) = (self.connection.run.clone(), &self.connection);
        let notes = match step {
            Step::Claim { .. } | Step::Play(_) => Vec::new(),
            Step::Scores(report) => {
                let (key, read) = (keys::scores(&run), ScoreReply::incarnation);
                let reply = connection.deliver(key, &report, timeout, read).await?;
                self.duty.scored(reply, Instant::now())
            }
            Step::Piece(piece) => {
                let (key, read) = (keys::experience(&run), PieceReply::incarnation);
                let reply = connection.deliver(key.clone(), &piece, timeout, read).await?;
                let unusable = |reason| QueryError::Unusable { key, reason };
                self.duty.sent(reply, Instant::now()).map_err(unusable)?
            }
            Step::HandBack { job, incarnation, failed } => {
                if connection.hand_back(job, incarnation, failed, timeout).await? {
                    info!(%run, "a job was handed back");
                }
                self.duty.handed_back(Instant::now());
                Vec::new()
            }
        };
        for note in notes {
            self.note(note);
        }
        Ok(())
    }

    fn note(&mut self, note: Note) {
        let Connection { run, metrics, .. } = &self.connection;
        match note {
            Note::Scored(report, [new, duplicates]) => {
                let scores = report.episodes.iter().map(|episode| episode.score);
                let mean = scores.clone().sum::<f64>() / report.episodes.len().max(1) as f64;
                scores.for_each(|score| metrics.episode_score.observe(score));
                let step = report.step;
                info!(%run, step, new, duplicates, "scores delivered, mean {mean:.2}");
                metrics.job("scored");
                self.last_warning.clear();
            }
            Note::Experience { step, seed, rows, duplicate } => {
                info!(%run, step, seed, rows, duplicate, "an online episode delivered");
                metrics.experience_rows.inc_by(rows);
                metrics.job("played");
                self.last_warning.clear();
            }
            Note::Early { step } => {
                debug!(%run, step, "the scores wait until the learner has trained to that step again");
            }
            Note::Abandoned { step, reason } => {
                warn!(%run, step, "{reason}");
                metrics.job("abandoned");
            }
        }
    }

    /// Logs an error, but not the same one twice in a row.
    fn warn(&mut self, error: &anyhow::Error) {
        let warning = format!("{error:#}");
        match self.last_warning == warning {
            false => warn!(run = %self.connection.run, "{warning}"),
            true => debug!(run = %self.connection.run, "{warning}"),
        }
        self.last_warning = warning;
    }

    /// The snapshot that `job` names: the published one or, if the evaluator missed it, a requested
    /// one.
    pub async fn snapshot(&self, job: &Job) -> anyhow::Result<Arc<Snapshot>> {
        match self.snapshots.get(&self.key, job) {
            Some(snapshot) => Ok(snapshot),
            None => Ok(Arc::new(self.connection.snapshot(job).await?)),
        }
    }

    /// Delivers the results, or hands the job back, before this evaluator ends.
    pub async fn leave(mut self) {
        let time = if self.duty.owes_episode() { LEAVE_EPISODE } else { LEAVE };
        let until = Instant::now() + time;
        self.duty.leave();
        self.duty.begin_turn();
        while let Some(step) = self.duty.next(0) {
            let done = timeout_at(until.into(), self.deliver(step, LEAVE / 2)).await;
            let late = |_| Err(QueryError::NoAnswer(keys::experience(&self.connection.run)));
            let Err(error) = done.unwrap_or_else(late) else { continue };
            let answered = matches!(error, QueryError::Unusable { .. });
            self.warn(&error.into());
            if !self.duty.leaving_failed(answered, Instant::now() + RETRY > until) {
                return;
            }
            tokio::time::sleep(RETRY).await;
        }
    }

    /// Stops serving the run, and drops results that were not acknowledged.
    pub fn give_up(self) {
        let Connection { run, metrics, .. } = &self.connection;
        self.snapshots.forget(&self.key);
        for step in self.duty.owed_steps() {
            warn!(%run, step, "the learner did not return; its results are dropped");
            metrics.job("abandoned");
        }
    }
}
