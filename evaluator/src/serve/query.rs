//! A query to a learner.

use std::time::Duration;

use quad_protocol::{CodecError, Message, decode_from};
use tracing::warn;
use zenoh::Session;

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
    /// The answer is not the message that the protocol prescribes.
    #[error("unusable answer at {key}")]
    Unusable {
        /// The key that was asked.
        key: String,
        /// What is wrong with the answer.
        source: CodecError,
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

/// Sends `question` to `key` and gives the first answer that can be decoded.
pub async fn ask<A: Message>(
    session: &Session,
    key: String,
    question: Vec<u8>,
    timeout: Duration,
    metrics: &Metrics,
) -> Result<A, AskError> {
    let replies = match session.get(&key).payload(question).timeout(timeout).await {
        Ok(replies) => replies,
        Err(source) => return Err(AskError::Send { key, source }),
    };
    let mut unusable = None;
    // The channel closes when everybody has answered, at once where nobody does.
    while let Ok(reply) = replies.recv_async().await {
        match reply.result() {
            Ok(sample) => match decode_from(sample.payload().len(), sample.payload().reader()) {
                Ok(answer) => return Ok(answer),
                Err(error) => {
                    metrics.rejected(error.label());
                    unusable = Some(error);
                }
            },
            Err(error) => {
                let text = error.payload().to_bytes();
                warn!(
                    key,
                    "the learner answered with an error: {}",
                    String::from_utf8_lossy(&text[..text.len().min(200)])
                );
            }
        }
    }
    Err(match unusable {
        Some(source) => AskError::Unusable { key, source },
        None => AskError::Silent { key },
    })
}
