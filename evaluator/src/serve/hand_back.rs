//! Hands a job back to its learner.

use std::time::Duration;

use quad_protocol::{Job, JobReply, JobRequest, Name, encode, keys};
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
}

impl HandBack {
    /// Of `evaluator`'s `job`.
    pub fn new(session: Session, metrics: Metrics, evaluator: Name, job: Job) -> HandBack {
        HandBack { session, metrics, evaluator, job }
    }

    /// Hands it back, within `patience`. Best effort: without it, the lease runs out.
    pub async fn send(self, patience: Duration) {
        let Job { id, lease, run, incarnation, .. } = self.job;
        let fitting = move |reply: &JobReply| match reply {
            JobReply::HandedBack { incarnation: of, .. } if *of == incarnation => Ok(()),
            JobReply::HandedBack { .. } => Err("other_incarnation"),
            _ => Err("unexpected"),
        };
        let Ok(request) = encode(&JobRequest::HandBack { evaluator: self.evaluator, job: id, lease }) else { return };
        match ask(&self.session, keys::jobs(&run), request, patience, &self.metrics, fitting).await {
            Ok(JobReply::HandedBack { accepted: true, .. }) => info!(%run, "a job was handed back"),
            Ok(_) => debug!(%run, "a job that was to be handed back had been taken away"),
            Err(error) => debug!(%run, %error, "a job could not be handed back"),
        }
    }
}
