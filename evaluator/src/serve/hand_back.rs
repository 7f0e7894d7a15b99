//! What is left to do for a job when the evaluator ends: its scores are delivered, or it is handed back to its learner.

use std::time::Duration;

use quad_protocol::{Job, JobReply, JobRequest, Name, ScoreReply, ScoreReport, encode, keys};
use tracing::{debug, info};
use zenoh::Session;

use super::query::ask;
use crate::metrics::Metrics;

/// A job that is to be handed back, so that it need not wait for the end of its lease.
pub struct HandBack {
    session: Session,
    metrics: Metrics,
    evaluator: Name,
    job: Job,
    /// Why it could not be done, if so.
    failed: Option<String>,
    /// Its scores, if the learner has not acknowledged them.
    scores: Option<ScoreReport>,
}

impl HandBack {
    /// Of `evaluator`'s `job`.
    pub fn new(session: Session, metrics: Metrics, evaluator: Name, job: Job) -> HandBack {
        HandBack { session, metrics, evaluator, job, failed: None, scores: None }
    }

    /// The job could not be done, and why.
    pub fn because(self, reason: String) -> HandBack {
        HandBack { failed: Some(reason), ..self }
    }

    /// The job is done, and only to be handed back if these cannot be delivered.
    pub fn with_scores(self, scores: ScoreReport) -> HandBack {
        HandBack { scores: Some(scores), ..self }
    }

    /// Delivers the scores if there are any, else hands the job back, each within half of `patience`. Best effort: without it,
    /// the lease runs out.
    pub async fn send(self, patience: Duration) {
        let patience = patience / 2;
        if self.deliver(patience).await {
            return;
        }
        let Job { id, lease, run, incarnation, .. } = self.job;
        let fitting = move |reply: &JobReply| match reply {
            JobReply::HandedBack { incarnation: of, .. } if *of == incarnation => Ok(()),
            JobReply::HandedBack { .. } => Err("other_incarnation"),
            _ => Err("unexpected"),
        };
        let (evaluator, failed) = (self.evaluator, self.failed);
        let Ok(request) = encode(&JobRequest::HandBack { evaluator, job: id, lease, failed }) else { return };
        match ask(&self.session, keys::jobs(&run), request, patience, &self.metrics, fitting).await {
            Ok(JobReply::HandedBack { accepted: true, .. }) => info!(%run, "a job was handed back"),
            Ok(_) => debug!(%run, "a job that was to be handed back had been taken away"),
            Err(error) => debug!(%run, %error, "a job could not be handed back"),
        }
    }

    async fn deliver(&self, patience: Duration) -> bool {
        let Some(Ok(message)) = self.scores.as_ref().map(encode) else { return false };
        let key = keys::scores(&self.job.run);
        // Anybody's answer will do, also that of a learner that was started again: the scores have gone out to everyone.
        let answer = ask(&self.session, key, message, patience, &self.metrics, |_: &ScoreReply| Ok(())).await;
        let delivered = matches!(answer, Ok(ScoreReply::Recorded { .. }));
        info!(run = %self.job.run, delivered, "scores that were not acknowledged before");
        delivered
    }
}
