//! What an evaluator owes a learner after a job, and how the learner gets it.

use std::time::{Duration, Instant};

use quad_protocol::{JobReply, JobRequest, ScoreReply, ScoreReport, encode, keys};
use tracing::{debug, info, warn};

use super::super::query::{AskError, ask};
use super::{ANSWER_TIMEOUT, RunClient, is_from};
use crate::metrics::JobOutcome;

/// How long a leaving evaluator tries to deliver its scores; it tries half as long to hand a job
/// back.
const LEAVE: Duration = Duration::from_secs(2);
/// A leaving evaluator delivers scores again this long after the learner answered with an error.
const AGAIN: Duration = Duration::from_millis(100);
/// Most characters of a reason that the evaluator sends: the learner accepts no large messages.
const LONGEST_REASON: usize = 1000;

/// What an evaluator owes a learner. While it owes anything, it claims no job.
pub(super) enum Owed {
    /// The episodes of a job; of one that has failed, word of that.
    Job { id: u64, incarnation: u64, failed: Option<String> },
    /// Scores that the learner has not acknowledged.
    Scores(ScoreReport),
}

impl RunClient {
    /// Whether the learner has not acknowledged all that it is to know of the last job.
    pub fn owes(&self) -> bool {
        self.owed.is_some()
    }

    /// Keeps the scores of the claimed job for delivery.
    pub fn keep(&mut self, report: ScoreReport) {
        self.owed = Some(Owed::Scores(report));
    }

    /// Delivers the kept scores to the learner process that this evaluator follows, or hands a
    /// failed job back to it. Keeps them after an error.
    pub async fn deliver(&mut self, timeout: Duration) -> anyhow::Result<()> {
        let Some(Owed::Scores(report)) = &self.owed else { return self.hand_back(timeout).await };
        let incarnation = self.incarnation;
        let fitting = move |reply: &ScoreReply| is_from(incarnation, reply.incarnation());
        let key = keys::scores(&self.run);
        let answer =
            ask(&self.session, key, encode(report)?, timeout, &self.metrics, fitting).await?;
        let (run, step) = (&self.run, report.step);
        match answer {
            ScoreReply::Recorded { new, duplicates, .. } => {
                let scores = report.episodes.iter().map(|episode| episode.score);
                let mean = scores.clone().sum::<f64>() / report.episodes.len().max(1) as f64;
                info!(%run, step, new, duplicates, "scores delivered, mean {mean:.2}");
                scores.for_each(|score| self.metrics.episode_score.observe(score));
                self.metrics.job(JobOutcome::Scored);
                self.owed = None;
                self.complaint.clear();
                self.turn.done(Instant::now(), Duration::ZERO);
                Ok(())
            }
            ScoreReply::Refused { reason, .. } => {
                warn!(%run, step, "the learner refused the scores: {reason}");
                self.metrics.job(JobOutcome::Abandoned);
                self.return_job(Some(format!("it refused the scores: {reason}")));
                self.hand_back(timeout).await
            }
        }
    }

    /// Hands back the claimed job, which this evaluator could not run; [`deliver`](Self::deliver)
    /// does so if there is no answer.
    pub async fn fail(&mut self, reason: &str) {
        self.metrics.job(JobOutcome::Failed);
        self.return_job(Some(reason.chars().take(LONGEST_REASON).collect()));
        if let Err(error) = self.hand_back(ANSWER_TIMEOUT).await {
            debug!(run = %self.run, "{error:#}");
        }
    }

    /// Before this evaluator ends: delivers the scores, or hands the job back, within a time limit.
    pub async fn leave(mut self) {
        let until = Instant::now() + LEAVE;
        let mut answered = false;
        while matches!(self.owed, Some(Owed::Scores(_))) {
            let Err(error) = self.deliver(LEAVE / 2).await else { return };
            // A learner that answers has received the scores, and may still save them; if it could
            // not, it says why. If the evaluator handed the job back now, others would run it
            // again.
            let unusable = matches!(error.downcast_ref(), Some(AskError::Unusable { .. }));
            answered |= unusable;
            if !unusable || Instant::now() + AGAIN > until {
                warn!(run = %self.run, "the learner has not acknowledged the scores: {error:#}");
                break;
            }
            tokio::time::sleep(AGAIN).await;
        }
        if !answered {
            self.return_job(None);
            while self.hand_back(LEAVE / 2).await.is_err() && Instant::now() + AGAIN < until {
                tokio::time::sleep(AGAIN).await;
            }
        }
    }

    /// Owes the job itself from now on; its scores are dropped.
    fn return_job(&mut self, reason: Option<String>) {
        self.owed = self.owed.take().map(|owed| match owed {
            Owed::Job { id, incarnation, failed } => {
                Owed::Job { id, incarnation, failed: reason.or(failed) }
            }
            Owed::Scores(report) => {
                Owed::Job { id: report.job, incarnation: report.incarnation, failed: reason }
            }
        });
    }

    /// Hands the job back to the learner that gave it.
    async fn hand_back(&mut self, timeout: Duration) -> anyhow::Result<()> {
        let Some(Owed::Job { id, incarnation, failed }) = &self.owed else { return Ok(()) };
        let (job, incarnation, failed) = (*id, *incarnation, failed.clone());
        let fitting = move |reply: &JobReply| match reply {
            JobReply::HandedBack { incarnation: of, .. } => is_from(incarnation, *of),
            _ => Err("unexpected"),
        };
        let request =
            encode(&JobRequest::HandBack { evaluator: self.evaluator.clone(), job, failed })?;
        match ask(&self.session, keys::jobs(&self.run), request, timeout, &self.metrics, fitting)
            .await
        {
            Ok(JobReply::HandedBack { accepted: true, .. }) => {
                info!(run = %self.run, "a job was handed back")
            }
            Err(error) if incarnation == self.incarnation => return Err(error.into()),
            // Where another learner is followed by now, the one that gave the job may be gone, and
            // is not waited for.
            Ok(_) | Err(_) => {}
        }
        self.owed = None;
        Ok(())
    }

    /// Stops serving the run, and drops scores that were not acknowledged.
    pub fn give_up(self) {
        self.snapshots.forget(&self.run);
        if let Some(Owed::Scores(report)) = &self.owed {
            warn!(run = %self.run, step = report.step, "the learner did not come back for its scores");
            self.metrics.job(JobOutcome::Abandoned);
        }
    }
}
