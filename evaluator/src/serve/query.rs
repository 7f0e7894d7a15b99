//! A query to a learner, and other calls of Zenoh that may block.

use std::time::Duration;

use quad_protocol::{Message, decode_from};
use tokio::sync::mpsc;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply};
use zenoh::{Session, Wait};

use crate::metrics::Metrics;

/// Most answers to one query that wait; one is enough, and few peers answer.
const MOST_ANSWERS: usize = 64;
/// Zenoh's own error where an answer has not come in time. It looks like a learner's, which it is
/// not.
const LATE: &[u8] = b"Timeout";
/// Most bytes of a learner's error in a message.
const LONGEST_ERROR: usize = 200;

/// Why a query brought no answer.
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    /// No learner or no network, or the answer took too long.
    #[error("no answer at {key}")]
    Silent { key: String },
    /// The learner's error, or what is wrong with its answer.
    #[error("unusable answer at {key}: {reason}")]
    Unusable { key: String, reason: String },
    #[error("cannot ask {key}: {reason}")]
    Send { key: String, reason: String },
}

/// Runs a call of Zenoh on a thread that may block. Zenoh's `get` and declarations do all their
/// work in the first poll of their futures. While a peer does not read, that poll blocks until
/// Zenoh closes the connection after two seconds, and the awaiting task with it.
pub async fn may_block<T: Send + 'static>(
    call: impl FnOnce() -> zenoh::Result<T> + Send + 'static,
) -> anyhow::Result<T> {
    tokio::task::spawn_blocking(call).await?.map_err(|error| anyhow::anyhow!(error))
}

/// Sends `question` to every learner at `key`. Returns the first answer that can be decoded and
/// that `fitting` accepts, without waiting for further ones; for a wrong answer `fitting` returns
/// the label of the reason.
pub async fn ask<A: Message + Send + 'static>(
    session: &Session,
    key: String,
    question: Vec<u8>,
    timeout: Duration,
    metrics: &Metrics,
    fitting: impl Fn(&A) -> Result<(), &'static str> + Send + Sync + 'static,
) -> Result<A, AskError> {
    let (tell, mut told) = mpsc::channel(MOST_ANSWERS);
    let get = {
        let (session, metrics, key) = (session.clone(), metrics.clone(), key.clone());
        move || {
            let callback = move |reply: Reply| {
                let is_late =
                    reply.result().err().is_some_and(|error| *error.payload().to_bytes() == *LATE);
                if !is_late && !tell.is_closed() {
                    tell.try_send(read(&reply, &metrics, &fitting)).ok();
                }
            };
            // All targets: the best matching target would be any peer that claims to be complete.
            // No consolidation, which would hold answers back until every peer has answered.
            let get = session.get(key).payload(question).timeout(timeout);
            get.target(QueryTarget::All)
                .consolidation(ConsolidationMode::None)
                .callback(callback)
                .wait()
        }
    };
    may_block(get)
        .await
        .map_err(|error| AskError::Send { key: key.clone(), reason: error.to_string() })?;
    let mut unusable = None;
    // Zenoh drops the callback, and with it the sender of the channel, after the last answer or the
    // timeout.
    while let Some(answer) = told.recv().await {
        match answer {
            Ok(answer) => return Ok(answer),
            Err(reason) => unusable = Some(reason),
        }
    }
    Err(match unusable {
        Some(reason) => AskError::Unusable { key, reason },
        None => AskError::Silent { key },
    })
}

fn read<A: Message>(
    reply: &Reply,
    metrics: &Metrics,
    fitting: &impl Fn(&A) -> Result<(), &'static str>,
) -> Result<A, String> {
    match reply.result() {
        Ok(sample) => {
            let answer = decode_from(sample.payload().len(), sample.payload().reader()).map_err(
                |error| {
                    metrics.rejected(error.label());
                    error.to_string()
                },
            )?;
            fitting(&answer).map_err(|label| {
                metrics.rejected(label);
                format!("it is not from the learner that was asked ({label})")
            })?;
            Ok(answer)
        }
        Err(error) => {
            let text = error.payload().to_bytes();
            Err(String::from_utf8_lossy(&text[..text.len().min(LONGEST_ERROR)]).into_owned())
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

    use quad_protocol::{JobReply, encode};
    use quad_runtime::{Endpoints, open_session, reachable_at};
    use tokio::time::{sleep, timeout};

    use super::*;

    const GLANCE: Duration = Duration::from_millis(10);

    /// Asks a learner that reads nothing until the task that asks lets it read on. Whether there is
    /// an answer.
    async fn is_answered() -> bool {
        let listen =
            Endpoints { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..Endpoints::default() };
        let learner = open_session(&listen).await.unwrap();
        let (stalls, has_stalled) =
            (Arc::new(AtomicBool::new(true)), Arc::new(AtomicBool::new(false)));
        // Until this callback returns, the learner's session reads nothing.
        let callback = {
            let (stalls, has_stalled) = (stalls.clone(), has_stalled.clone());
            move |_| {
                has_stalled.store(true, Relaxed);
                while stalls.load(Relaxed) {
                    std::thread::sleep(GLANCE);
                }
            }
        };
        let answer = encode(&JobReply::Wait { incarnation: 1, milliseconds: 1 }).unwrap();
        let answers = move |query: zenoh::query::Query| {
            query.reply(query.key_expr().clone(), answer.clone()).wait().ok();
        };
        let _jobs = learner.declare_queryable("quad/run/jobs").callback(answers).await.unwrap();
        let _flooded = learner.declare_subscriber("flood").callback(callback).await.unwrap();
        let connect = Endpoints {
            connect: reachable_at(&learner, &listen).await.unwrap(),
            ..Endpoints::default()
        };
        let evaluator = open_session(&connect).await.unwrap();
        let reaches = async {
            while !has_stalled.load(Relaxed) {
                evaluator.put("flood", "").await.unwrap();
                sleep(GLANCE).await;
            }
        };
        timeout(Duration::from_secs(60), reaches).await.expect("the learner is reached");
        for _ in 0..2000 {
            // More than the connection's buffers hold.
            evaluator.put("flood", vec![0; 20_000]).await.unwrap();
        }
        let metrics = Metrics::new().unwrap();
        let (key, limit) = ("quad/run/jobs".to_owned(), Duration::from_secs(20));
        let asked = ask(&evaluator, key, Vec::new(), limit, &metrics, |_: &JobReply| Ok(()));
        let reads_on = async {
            sleep(10 * GLANCE).await;
            stalls.store(false, Relaxed);
        };
        tokio::join!(asked, reads_on).0.is_ok()
    }

    /// A task that waits for the peer does so until Zenoh has closed the connection, and lets
    /// nothing be read before.
    #[tokio::test(flavor = "multi_thread")]
    async fn a_peer_that_does_not_read_does_not_stop_the_task_that_asks() {
        // Where the machine is too busy, Zenoh may close it all the same.
        for _ in 0..5 {
            if is_answered().await {
                return;
            }
        }
        panic!("the task stood still");
    }
}
