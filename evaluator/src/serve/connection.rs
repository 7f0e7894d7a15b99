//! An evaluator's requests to the learner of one run, and other calls of Zenoh that may block.

use std::time::Duration;

use quad_protocol::{
    CodecError, Job, JobReply, JobRequest, Message, Name, Progress, Snapshot, decode_from, encode,
    keys,
};
use tokio::sync::mpsc;
use tracing::debug;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply};
use zenoh::{Session, Wait};

use crate::metrics::Metrics;

/// A learner answers in milliseconds. Other runs wait no longer than this for one that hangs.
pub const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit of a snapshot's transfer.
const WEIGHTS_TIMEOUT: Duration = Duration::from_secs(30);

/// Capacity for answers to one query. One answer is enough, and few peers answer.
const MAX_ANSWERS: usize = 64;
/// The error with which Zenoh itself, not the learner, replies to a query that timed out.
const ZENOH_TIMEOUT: &[u8] = b"Timeout";
/// Most bytes of a learner's error in a message.
const MAX_ERROR_LEN: usize = 200;

#[derive(Debug, thiserror::Error)]
pub enum QueryError {
    #[error("no answer at {0}")]
    NoAnswer(String),
    /// The learner's error, or the fault of its answer.
    #[error("unusable answer at {key}: {reason}")]
    Unusable { key: String, reason: String },
    #[error("cannot send a query to {key}: {reason}")]
    Send { key: String, reason: String },
    #[error(transparent)]
    Encode(#[from] CodecError),
}

/// Runs a call of Zenoh on a thread that may block.
///
/// Zenoh's `get` and declarations do all their work in the first poll of their futures. While a
/// peer does not read, that poll blocks until Zenoh closes the connection after two seconds.
pub async fn blocking<T: Send + 'static>(
    call: impl FnOnce() -> zenoh::Result<T> + Send + 'static,
) -> anyhow::Result<T> {
    let result = tokio::task::spawn_blocking(call).await?;
    result.map_err(|error| anyhow::anyhow!(error))
}

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
        let check = move |snapshot: &Snapshot| match is_named_by(&job, snapshot) {
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

    /// Sends `payload` to every learner at `key`, and returns the first answer that can be decoded and
    /// passes `check`. For a wrong answer, `check` returns the label of the reason.
    async fn query<A: Message + Send + 'static>(
        &self,
        key: String,
        payload: Vec<u8>,
        timeout: Duration,
        check: impl Fn(&A) -> Result<(), &'static str> + Send + Sync + 'static,
    ) -> Result<A, QueryError> {
        let (tx, mut rx) = mpsc::channel(MAX_ANSWERS);
        let metrics = self.metrics.clone();
        let callback = move |reply: Reply| {
            let error = reply.result().err().map(|error| error.payload().to_bytes());
            if error.is_none_or(|error| *error != *ZENOH_TIMEOUT) && !tx.is_closed() {
                tx.try_send(read(&reply, &metrics, &check)).ok();
            }
        };
        let (session, selector) = (self.session.clone(), key.clone());
        let get = move || {
            // All targets: the best matching target would be any peer that claims to be complete.
            let get = session.get(selector).target(QueryTarget::All);
            // Consolidation would hold answers back until every peer has answered.
            let get = get.consolidation(ConsolidationMode::None);
            get.payload(payload).timeout(timeout).callback(callback).wait()
        };
        if let Err(error) = blocking(get).await {
            let reason = error.to_string();
            return Err(QueryError::Send { key, reason });
        }
        let mut unusable = None;
        // Zenoh drops the callback, and with it `tx`, after the last answer or the timeout.
        while let Some(answer) = rx.recv().await {
            match answer {
                Ok(answer) => return Ok(answer),
                Err(reason) => unusable = Some(reason),
            }
        }
        Err(match unusable {
            Some(reason) => QueryError::Unusable { key, reason },
            None => QueryError::NoAnswer(key),
        })
    }
}

fn read<A: Message>(
    reply: &Reply,
    metrics: &Metrics,
    check: &impl Fn(&A) -> Result<(), &'static str>,
) -> Result<A, String> {
    let sample = reply.result().map_err(|error| {
        let text = error.payload().to_bytes();
        String::from_utf8_lossy(&text[..text.len().min(MAX_ERROR_LEN)]).into_owned()
    })?;
    let rejected = |label: &'static str, reason| {
        metrics.rejected(label);
        reason
    };
    let payload = sample.payload();
    let answer = decode_from(payload.len(), payload.reader())
        .map_err(|error| rejected(error.label(), error.to_string()))?;
    check(&answer).map_err(|label| {
        let reason = format!("it is not from the learner that was asked ({label})");
        rejected(label, reason)
    })?;
    Ok(answer)
}

/// Checks that a reply comes from the followed learner process.
fn is_from(followed: u64, incarnation: u64) -> Result<(), &'static str> {
    match incarnation == followed {
        true => Ok(()),
        false => Err("other_incarnation"),
    }
}

/// Compares everything but the file, whose hash decoding has verified.
pub fn is_named_by(job: &Job, snapshot: &Snapshot) -> bool {
    let origin = (&snapshot.run, snapshot.incarnation);
    origin == (&job.run, job.incarnation)
        && (snapshot.step, snapshot.hash) == (job.step, job.weights)
}
