//! A query to a learner.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use quad_protocol::{Message, decode_from};
use tokio::sync::oneshot;
use tracing::{debug, warn};
use zenoh::Session;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply};

use crate::metrics::Metrics;

/// Why a question brought no answer.
#[derive(Debug, thiserror::Error)]
pub enum AskError {
    /// No learner, no network, or the answer took too long.
    #[error("nobody answered {key}")]
    Silent {
        /// The key that was asked.
        key: String,
    },
    /// What came was not the answer of the learner that was asked.
    #[error("unusable answer at {key}: {reason}")]
    Unusable {
        /// The key that was asked.
        key: String,
        /// What is wrong with the answer.
        reason: String,
    },
    /// Zenoh could not send the question.
    #[error("cannot ask {key}: {source}")]
    Send {
        /// The key that was asked.
        key: String,
        /// Zenoh's own words.
        source: zenoh::Error,
    },
}

/// After an answer, at least so much time passes before the next question of its kind. A router drops those that come closer
/// together (`downsampling` in its configuration, deploy/zenoh/router.json5): those of a stranger's flood, and it would drop
/// those of an evaluator of many runs.
const APART: Duration = Duration::from_millis(50);
/// The same for weights, of which it lets fewer through.
const WEIGHTS_APART: Duration = Duration::from_millis(250);

/// When the last question of each kind was asked or, later, over.
static LAST: Mutex<BTreeMap<String, Instant>> = Mutex::new(BTreeMap::new());

/// What is asked for at `key`, which a router counts for all runs together: `jobs`, `scores` or `weights`.
fn kind(key: &str) -> &str {
    key.split('/').nth(2).unwrap_or_default()
}

/// The right to ask a question of its kind, until that is over.
pub struct Turn(String);

/// Waits until this process may ask its next question of the kind of `key`.
pub async fn take_turn(key: &str) -> Turn {
    let turn = Turn(kind(key).to_owned());
    let apart = if turn.0 == "weights" { WEIGHTS_APART } else { APART };
    tokio::time::sleep_until(turn.note(apart).into()).await;
    turn
}

impl Turn {
    /// Of a question that is asked so long after the last one, or of one that is over.
    fn note(&self, after: Duration) -> Instant {
        let mut last = LAST.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        let turn = last.get(&self.0).map_or(now, |&last| now.max(last + after));
        last.insert(self.0.clone(), turn);
        turn
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        self.note(Duration::ZERO);
    }
}

/// What one question gathers.
struct Gathered<A> {
    /// Gone as soon as there is an answer.
    tell: Option<oneshot::Sender<A>>,
    unusable: Option<String>,
}

/// Sends `question` to everybody at `key` and gives the first answer that can be decoded and is `fitting`, which gives the
/// metric's label of what is wrong with one that is not. Whoever else answers, or never does, is not waited for.
pub async fn ask<A: Message + Send + 'static>(
    session: &Session,
    key: String,
    question: Vec<u8>,
    timeout: Duration,
    metrics: &Metrics,
    fitting: impl Fn(&A) -> Result<(), &'static str> + Send + Sync + 'static,
) -> Result<A, AskError> {
    let _turn = take_turn(&key).await;
    let (tell, told) = oneshot::channel();
    let gathered = Arc::new(Mutex::new(Gathered { tell: Some(tell), unusable: None }));
    let callback = {
        // Only the callback holds the sender, so that it goes when nobody can answer any more.
        let (gathered, metrics, key) = (gathered.clone(), metrics.clone(), key.clone());
        let end = EndOfAnswers(gathered.clone());
        move |reply: Reply| {
            let gathered = &mut *end.0.lock().unwrap_or_else(PoisonError::into_inner);
            if gathered.tell.is_none() {
                return;
            }
            match read(&reply, &key, &metrics, &fitting) {
                Ok(answer) => {
                    // The asker may have gone.
                    gathered.tell.take().and_then(|tell| tell.send(answer).ok());
                }
                Err(reason) => gathered.unusable = Some(reason),
            }
        }
    };
    // All, not the best matching: that would be whoever claims to be complete. None, because consolidation would hold
    // answers back until everybody has answered.
    let get = session.get(&key).payload(question).timeout(timeout);
    let sent = get.target(QueryTarget::All).consolidation(ConsolidationMode::None).callback(callback).await;
    sent.map_err(|source| AskError::Send { key: key.clone(), source })?;
    match told.await {
        Ok(answer) => Ok(answer),
        Err(_) => match gathered.lock().unwrap_or_else(PoisonError::into_inner).unusable.take() {
            Some(reason) => Err(AskError::Unusable { key, reason }),
            None => Err(AskError::Silent { key }),
        },
    }
}

/// Dropped with the callback, after the last answer or the timeout: ends the asker's wait.
struct EndOfAnswers<A>(Arc<Mutex<Gathered<A>>>);

impl<A> Drop for EndOfAnswers<A> {
    fn drop(&mut self) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).tell = None;
    }
}

fn read<A: Message>(
    reply: &Reply,
    key: &str,
    metrics: &Metrics,
    fitting: &impl Fn(&A) -> Result<(), &'static str>,
) -> Result<A, String> {
    match reply.result() {
        Ok(sample) => {
            let answer = decode_from(sample.payload().len(), sample.payload().reader()).map_err(|error| {
                metrics.rejected(error.label());
                error.to_string()
            })?;
            fitting(&answer).map_err(|label| {
                metrics.rejected(label);
                debug!(key, label, "an answer that is not for this question");
                format!("it is not from the learner that was asked ({label})")
            })?;
            Ok(answer)
        }
        Err(error) => {
            let text = error.payload().to_bytes();
            let text = String::from_utf8_lossy(&text[..text.len().min(200)]).into_owned();
            warn!(key, "the learner answered with an error: {text}");
            Err(text)
        }
    }
}

#[cfg(test)]
mod tests {
    use quad_protocol::{Name, keys};

    use super::kind;

    #[test]
    fn a_kind_is_what_is_asked_for_whatever_the_run() {
        let [one, other] = ["one", "other"].map(|run| Name::new(run).unwrap());
        let kinds =
            |run| [keys::jobs(run), keys::scores(run), keys::weights_at(run, 7)].map(|key| kind(&key).to_owned());
        assert_eq!(kinds(&one), ["jobs", "scores", "weights"]);
        assert_eq!(kinds(&other), kinds(&one));
    }
}
