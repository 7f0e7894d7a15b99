//! An evaluator's requests to the learner of one run.

use std::time::Duration;

use quad_protocol::{Job, JobReply, JobRequest, Message, Name, Progress, Snapshot, encode, keys};
use tracing::debug;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};

use super::query::{QueryError, query};
use super::snapshot::is_named_by;
use crate::metrics::Metrics;

/// A learner answers in milliseconds. Other runs wait no longer than this for one that hangs.
pub const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit of a snapshot's transfer.
const WEIGHTS_TIMEOUT: Duration = Duration::from_secs(30);

/// One evaluator's connection to the learner of one run.
pub struct Connection {
    pub run: Name,
    pub evaluator: Name,
    pub session: Session,
    pub metrics: Metrics,
    /// The learner process that the evaluator follows; answers of others are ignored.
    pub incarnation: u64,
}

impl Connection {
    /// Claims a job in one of these environments. A repeated claim has the same `attempt`: if only
    /// the answer was lost, the learner repeats the job.
    pub async fn claim(
        &self,
        attempt: u64,
        environments: Vec<String>,
    ) -> Result<JobReply, QueryError> {
        let evaluator = self.evaluator.clone();
        let request = encode(&JobRequest::Claim { evaluator, attempt, environments })?;
        let (run, incarnation) = (self.run.clone(), self.incarnation);
        let check = move |reply: &JobReply| match reply {
            JobReply::Job(job) if job.run != run => Err("other_run"),
            JobReply::HandedBack { .. } => Err("unexpected"),
            reply => is_from(incarnation, reply.incarnation()),
        };
        let key = keys::jobs(&self.run);
        self.query(key, request, ANSWER_TIMEOUT, check).await
    }

    /// Hands a job back to the learner process that gave it. Returns whether the evaluator still
    /// had it.
    pub async fn hand_back(
        &self,
        job: u64,
        incarnation: u64,
        failed: Option<String>,
        timeout: Duration,
    ) -> Result<bool, QueryError> {
        let evaluator = self.evaluator.clone();
        let request = encode(&JobRequest::HandBack { evaluator, job, failed })?;
        let check = move |reply: &JobReply| match reply {
            JobReply::HandedBack { .. } => is_from(incarnation, reply.incarnation()),
            _ => Err("unexpected"),
        };
        let key = keys::jobs(&self.run);
        let reply = self.query(key, request, timeout, check).await?;
        Ok(matches!(reply, JobReply::HandedBack { accepted: true, .. }))
    }

    /// Delivers results. Of the learner's answer, `incarnation_of` reads whose it is.
    pub async fn deliver<A: Message + Send + 'static>(
        &self,
        key: String,
        results: &impl Message,
        timeout: Duration,
        incarnation_of: fn(&A) -> u64,
    ) -> Result<A, QueryError> {
        let incarnation = self.incarnation;
        let check = move |reply: &A| is_from(incarnation, incarnation_of(reply));
        self.query(key, encode(results)?, timeout, check).await
    }

    /// Requests the snapshot that `job` names.
    pub async fn snapshot(&self, job: &Job) -> Result<Snapshot, QueryError> {
        let (key, job) = (keys::weights_at(&self.run, job.step), job.clone());
        let check = move |found: &Snapshot| match is_named_by(&job, found) {
            true => Ok(()),
            false => Err("other_snapshot"),
        };
        let snapshot = self.query(key, Vec::new(), WEIGHTS_TIMEOUT, check).await?;
        self.metrics.snapshots_received.inc();
        Ok(snapshot)
    }

    /// Publishes the progress of `job`. A full connection drops the message, which the next one
    /// replaces.
    pub fn publish_progress(&self, job: &Job, steps_done: u64, episodes_done: u32) {
        let progress = Progress {
            steps_done,
            episodes_done,
            environment_steps: self.metrics.environment_steps.get(),
            episodes: self.metrics.episodes.get(),
            ..Progress::new(job, self.evaluator.clone())
        };
        let Ok(message) = encode(&progress) else { return };
        let key = keys::progress(&self.run, &self.evaluator);
        let put = self.session.put(key, message);
        if let Err(error) = put.congestion_control(CongestionControl::Drop).wait() {
            debug!(run = %self.run, "cannot publish progress: {error}");
        }
    }

    async fn query<A: Message + Send + 'static>(
        &self,
        key: String,
        payload: Vec<u8>,
        timeout: Duration,
        check: impl Fn(&A) -> Result<(), &'static str> + Send + Sync + 'static,
    ) -> Result<A, QueryError> {
        query(&self.session, key, payload, timeout, &self.metrics, check).await
    }
}

/// Checks that a reply comes from the followed learner process.
fn is_from(followed: u64, incarnation: u64) -> Result<(), &'static str> {
    match incarnation == followed {
        true => Ok(()),
        false => Err("other_incarnation"),
    }
}
