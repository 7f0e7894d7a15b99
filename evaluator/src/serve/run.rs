//! Everything that is exchanged with the learner of one run: jobs, snapshots, progress, scores.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context;
use quad_protocol::{
    Job, JobReply, JobRequest, Name, Progress, ScoreReply, ScoreReport, Snapshot, WeightsRequest, encode, keys,
};
use rand::Rng;
use tokio::sync::Notify;
use tracing::{debug, info, warn};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;

use super::budget::Budget;
use super::discovery::Found;
use super::hand_back::HandBack;
use super::query::ask;
use super::snapshots::SnapshotReceiver;
use super::turns::Standing;
use crate::metrics::{JobOutcome, Metrics};

/// A learner answers in milliseconds; one that takes this long hangs, and other runs wait behind it.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// The same for a snapshot, which has megabytes to carry over whatever network there is.
const WEIGHTS_TIMEOUT: Duration = Duration::from_secs(30);
/// Bounds of the pause that a learner without work may ask for: one too short would be a flood of questions, one too
/// long would lose the evaluator.
const WAIT: [Duration; 2] = [Duration::from_millis(20), Duration::from_secs(60)];

/// Who an evaluator is to every learner.
#[derive(Clone)]
pub struct Identity {
    /// Its name.
    pub evaluator: Name,
    /// The arithmetic that it computes policies in.
    pub precision: Name,
}

/// An evaluator's side of one run.
pub struct RunClient {
    run: Name,
    identity: Identity,
    session: Session,
    metrics: Metrics,
    snapshots: SnapshotReceiver,
    /// Whose answers are believed.
    incarnation: u64,
    /// Of the claim that has no answer yet.
    attempt: Option<u64>,
    /// When progress was last reported.
    told: Mutex<Option<Instant>>,
    /// Scores that the learner has not acknowledged. While there are some, nothing new is asked for.
    undelivered: Option<ScoreReport>,
    /// Set when its learner has accepted scores.
    proven: Arc<AtomicBool>,
    /// Its claim to this evaluator's time.
    pub standing: Standing,
    /// What was last complained about, so that it is not said again and again.
    complaint: String,
    _token: LivelinessToken,
}

impl RunClient {
    /// Subscribes to the run's snapshots and announces the evaluator in it; `snapshot_arrived` is told of each new one.
    pub async fn attach(
        run: Name,
        found: &Found,
        identity: Identity,
        metrics: Metrics,
        (snapshot_arrived, budget): (Arc<Notify>, Budget),
    ) -> anyhow::Result<RunClient> {
        let session = found.session.clone();
        let readable = |error: zenoh::Error| anyhow::anyhow!(error);
        let snapshots = SnapshotReceiver::listen(&session, run.clone(), metrics.clone(), snapshot_arrived, budget)
            .await
            .map_err(readable)
            .with_context(|| format!("cannot listen to the snapshots of run {run}"))?;
        let token = session
            .liveliness()
            .declare_token(keys::live_evaluator(&run, &identity.evaluator))
            .await
            .map_err(readable)
            .with_context(|| format!("cannot announce this evaluator in run {run}"))?;
        let mut client = RunClient {
            run,
            identity,
            session,
            metrics,
            snapshots,
            incarnation: 0,
            attempt: None,
            told: Mutex::default(),
            undelivered: None,
            proven: found.proven.clone(),
            standing: Standing::new(Instant::now()),
            complaint: String::new(),
            _token: token,
        };
        client.follow(found);
        Ok(client)
    }

    /// Follows the learner that it follows already, if that is among these; else the one that was started first, because of two
    /// learners of one name the later one stops.
    pub fn follow(&mut self, Found { lives, proven, .. }: &Found) {
        // A run that has gone and come again is found anew.
        proven.fetch_or(self.proven.load(Relaxed), Relaxed);
        self.proven = proven.clone();
        if let Some(&first) = lives.first()
            && !lives.contains(&self.incarnation)
        {
            self.turn_to(first);
        }
    }

    /// Follows the next of several, because this one does not answer.
    pub fn follow_next(&mut self, lives: &BTreeSet<u64>) {
        let next = lives.range(self.incarnation.saturating_add(1)..).next().or(lives.first());
        if let Some(&next) = next.filter(|next| **next != self.incarnation) {
            self.turn_to(next);
        }
    }

    fn turn_to(&mut self, incarnation: u64) {
        debug!(run = %self.run, incarnation, "following a learner");
        self.incarnation = incarnation;
        self.attempt = None;
        self.snapshots.follow(incarnation);
        self.standing.wake(Instant::now());
    }

    /// Lets the learner be asked at once if it has published a snapshot, unless something went wrong with it before.
    pub fn wake_for_snapshot(&mut self) {
        if self.snapshots.take_news() {
            self.standing.nudge(Instant::now());
        }
    }

    /// Asks the learner nothing for a while, which is longer each time. Says why, unless it is the same as the last time.
    pub fn back_off(&mut self, error: &anyhow::Error) {
        let complaint = format!("{error:#}");
        match self.complaint == complaint {
            false => warn!(run = %self.run, "{complaint}"),
            true => debug!(run = %self.run, "{complaint}"),
        }
        self.complaint = complaint;
        self.standing.failed(Instant::now());
    }

    /// Whether scores wait for an acknowledgement.
    pub fn has_undelivered(&self) -> bool {
        self.undelivered.is_some()
    }

    /// Asks for a job; `None` when there is none now.
    pub async fn claim(&mut self, environments: Vec<String>) -> anyhow::Result<Option<Job>> {
        let Identity { evaluator, precision } = self.identity.clone();
        // The same number until there is an answer: if only that was lost, the job is not.
        let attempt = *self.attempt.get_or_insert_with(|| rand::rng().random());
        let request = encode(&JobRequest::Claim { evaluator, attempt, environments, precision })?;
        let (run, incarnation) = (self.run.clone(), self.incarnation);
        let fitting = move |reply: &JobReply| match reply {
            reply if reply.incarnation() != incarnation => Err("other_incarnation"),
            JobReply::Job(job) if job.run != run => Err("other_run"),
            JobReply::HandedBack { .. } => Err("unexpected"),
            _ => Ok(()),
        };
        let key = keys::jobs(&self.run);
        let answer = ask(&self.session, key, request, ANSWER_TIMEOUT, &self.metrics, fitting).await?;
        self.attempt = None;
        match answer {
            JobReply::Job(job) => Ok(Some(job)),
            JobReply::Wait { milliseconds, .. } => {
                self.complaint.clear();
                let wait = Duration::from_millis(milliseconds).clamp(WAIT[0], WAIT[1]);
                // Those that a snapshot has woken together do not come back together.
                let wait = wait.mul_f64(rand::random_range(0.5..1.0));
                self.standing.rest_until(Instant::now() + wait);
                Ok(None)
            }
            JobReply::HandedBack { .. } => Ok(None),
        }
    }

    /// What hands `job` back, also when this client is busy.
    pub fn hand_back(&self, job: &Job) -> HandBack {
        HandBack::new(self.session.clone(), self.metrics.clone(), self.identity.evaluator.clone(), job.clone())
    }

    /// The snapshot that `job` names: as it was published, or asked for where that was missed.
    pub async fn snapshot(&self, job: &Job) -> anyhow::Result<Arc<Snapshot>> {
        if let Some(snapshot) = self.snapshots.get(job) {
            return Ok(snapshot);
        }
        let key = keys::weights_at(&self.run, job.step);
        let request = encode(&WeightsRequest { evaluator: self.identity.evaluator.clone() })?;
        let wanted = (job.run.clone(), job.incarnation, job.step, job.weights);
        let fitting = move |found: &Snapshot| {
            let (run, incarnation, step, weights) = &wanted;
            let is_it = (&found.run, &found.incarnation, &found.step) == (run, incarnation, step);
            if is_it && found.hash == *weights { Ok(()) } else { Err("other_snapshot") }
        };
        let snapshot: Snapshot = ask(&self.session, key, request, WEIGHTS_TIMEOUT, &self.metrics, fitting).await?;
        self.metrics.snapshots_received.inc();
        Ok(Arc::new(snapshot))
    }

    /// Reports progress to the learner, unless that was done less than `every` ago, be it in an earlier job. A message that is
    /// lost or left out does not matter: the next one says the same and more.
    pub async fn tell(&self, job: &Job, every: Duration, (steps_done, episodes_done): (u64, u32)) {
        let now = Instant::now();
        {
            let mut told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
            if told.is_some_and(|told| now - told < every) {
                return;
            }
            *told = Some(now);
        }
        let progress = Progress {
            steps_done,
            episodes_done,
            environment_steps: self.metrics.environment_steps.get(),
            episodes: self.metrics.episodes.get(),
            ..Progress::of(job, self.identity.evaluator.clone())
        };
        let key = keys::progress(&self.run, &self.identity.evaluator);
        let sent = match encode(&progress.signed(&job.lease)) {
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

    /// Delivers the scores that are kept, to whichever life of the learner is there. An error means that they are still kept.
    pub async fn deliver(&mut self) -> anyhow::Result<()> {
        let Some(report) = &self.undelivered else { return Ok(()) };
        let incarnation = self.incarnation;
        let fitting = move |reply: &ScoreReply| match reply.incarnation() == incarnation {
            true => Ok(()),
            false => Err("other_incarnation"),
        };
        let key = keys::scores(&self.run);
        let answer = ask(&self.session, key, encode(report)?, ANSWER_TIMEOUT, &self.metrics, fitting).await?;
        let (run, step) = (&self.run, report.step);
        let accepted = matches!(answer, ScoreReply::Recorded { .. });
        match answer {
            ScoreReply::Recorded { new, duplicates, .. } => {
                let scores = report.episodes.iter().map(|episode| episode.score);
                let mean = scores.clone().sum::<f64>() / report.episodes.len().max(1) as f64;
                info!(%run, step, new, duplicates, "scores delivered, mean {mean:.2}");
                scores.for_each(|score| self.metrics.episode_score.observe(score));
                self.metrics.job(JobOutcome::Scored);
            }
            ScoreReply::Refused { reason, .. } => {
                warn!(%run, step, "the learner refused the scores: {reason}");
                self.metrics.job(JobOutcome::Abandoned);
            }
        }
        self.undelivered = None;
        self.complaint.clear();
        self.standing.delivered(accepted);
        self.proven.fetch_or(accepted, Relaxed);
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

#[cfg(test)]
mod tests;
