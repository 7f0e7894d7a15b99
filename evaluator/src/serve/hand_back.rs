//! What is left to do for a job when the evaluator ends: its scores are delivered, or it is handed back to its learner.

use std::time::{Duration, Instant};

use quad_protocol::{Job, JobReply, JobRequest, Name, ScoreReply, ScoreReport, encode, keys};
use tracing::{debug, info};
use zenoh::Session;

use super::query::{AskError, ask};
use crate::metrics::Metrics;

/// Scores that the learner answers with an error are delivered again after this time.
const AGAIN: Duration = Duration::from_millis(100);
/// Longest reason that a learner is told, characters: it takes no large messages.
const LONGEST_REASON: usize = 1000;

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
    pub fn because(self, reason: &str) -> HandBack {
        HandBack { failed: Some(reason.chars().take(LONGEST_REASON).collect()), ..self }
    }

    /// The job is done, and only to be handed back if these cannot be delivered.
    pub fn with_scores(self, scores: ScoreReport) -> HandBack {
        HandBack { scores: Some(scores), ..self }
    }

    /// Delivers the scores if there are any, else, or if nobody answers within half of `patience`, hands the job back. Best
    /// effort: without it, the lease runs out.
    pub async fn send(self, patience: Duration) {
        if self.deliver(patience).await {
            return;
        }
        let patience = patience / 2;
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

    /// Whether nothing is to be handed back any more.
    async fn deliver(&self, patience: Duration) -> bool {
        let Some(Ok(message)) = self.scores.as_ref().map(encode) else { return false };
        let key = keys::scores(&self.job.run);
        let until = Instant::now() + patience;
        loop {
            // Anybody's answer will do, also that of a learner that was started again: the scores have gone out to everyone.
            let fitting = |_: &ScoreReply| Ok(());
            let answer = ask(&self.session, key.clone(), message.clone(), patience / 2, &self.metrics, fitting).await;
            // It has them, perhaps from a delivery before, but not on its disk yet. If the job went back, others would do it
            // again.
            let not_yet = matches!(answer, Err(AskError::Unusable { .. }));
            if not_yet && Instant::now() + AGAIN < until {
                tokio::time::sleep(AGAIN).await;
                continue;
            }
            let delivered = matches!(answer, Ok(ScoreReply::Recorded { .. }));
            info!(run = %self.job.run, delivered, "scores that were not acknowledged before");
            return delivered || not_yet;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use quad_protocol::{Hash, Lease, decode};
    use quad_service::{Endpoints, open_session};
    use zenoh::Wait;
    use zenoh::query::Query;

    use super::*;

    /// What a learner hears of an evaluator that leaves, if it answers the first so many deliveries with errors, and how long
    /// that takes.
    async fn heard(errors: usize, patience: Duration) -> (Vec<&'static str>, Duration) {
        let endpoints = Endpoints { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..Endpoints::default() };
        let session = open_session(&endpoints).await.unwrap();
        let (run, evaluator) = (Name::new("run").unwrap(), Name::new("leaves").unwrap());
        let heard = Arc::new(Mutex::new(Vec::new()));
        let answer = {
            let (heard, scores) = (heard.clone(), keys::scores(&run));
            move |query: Query| {
                let mut heard = heard.lock().unwrap();
                if query.key_expr().as_str() != scores {
                    let request = query.payload().map(|payload| decode(&payload.to_bytes()));
                    assert!(matches!(request, Some(Ok(JobRequest::HandBack { .. }))));
                    heard.push("job");
                    let reply = encode(&JobReply::HandedBack { incarnation: 1, accepted: true }).unwrap();
                    return query.reply(query.key_expr().clone(), reply).wait().unwrap();
                }
                heard.push("scores");
                match heard.len() > errors {
                    true => {
                        let reply = ScoreReply::Recorded { incarnation: 1, new: 0, duplicates: 1 };
                        query.reply(query.key_expr().clone(), encode(&reply).unwrap()).wait().unwrap();
                    }
                    false => query.reply_err("they are being written").wait().unwrap(),
                }
            }
        };
        let _learner = session.declare_queryable("quad/run/*").callback(answer).await.unwrap();
        let job = Job {
            id: 1,
            lease: Lease::random(),
            run,
            incarnation: 1,
            step: 1,
            weights: Hash::of(b""),
            environment: "hopper".to_owned(),
            instance: 1,
            seeds: vec![1],
            candidates: 1,
            progress_milliseconds: 300,
        };
        let report = ScoreReport::of(&job, evaluator.clone(), Name::new("f32").unwrap(), Vec::new());
        let begin = Instant::now();
        let hand_back = HandBack::new(session.clone(), Metrics::new().unwrap(), evaluator, job);
        hand_back.with_scores(report).send(patience).await;
        let heard = heard.lock().unwrap().clone();
        (heard, begin.elapsed())
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn scores_that_are_being_written_are_delivered_again_and_their_job_is_not_handed_back() {
        let (heard_in_time, _) = heard(2, Duration::from_secs(20)).await;
        assert_eq!(heard_in_time, ["scores"; 3]);
        let (heard_never, took) = heard(usize::MAX, Duration::from_secs(1)).await;
        assert!(heard_never.len() > 3 && heard_never.iter().all(|what| *what == "scores"), "{heard_never:?}");
        assert!(took < Duration::from_secs(3), "{took:?}");
    }
}
