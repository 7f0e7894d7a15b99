//! Zenoh queries that wait for their answers, and the reasons not to accept a message.

use std::mem;

use quad_protocol::{CodecError, Message, decode, encode};
use tracing::debug;
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use super::metrics::Metrics;

/// Largest message to the learner, bytes; a score report of the largest job has 1.4 KB. A learner
/// that listens receives no fragmented messages, which begin at 32,700 bytes at the earliest.
const MOST_BYTES: usize = 30 * 1024;

/// A query and its message.
#[derive(Debug)]
pub(crate) struct Request {
    query: Query,
    payload: ZBytes,
}

impl Request {
    /// Drops the message if it is larger than allowed.
    pub fn new(mut query: Query) -> Self {
        drop(query.attachment_mut().map(mem::take));
        let payload = query.payload_mut().map(mem::take).unwrap_or_default();
        Self { query, payload }
    }

    pub fn key(&self) -> &str {
        self.query.key_expr().as_str()
    }

    /// The query's message; the request does not keep it.
    pub fn message<M: Message>(&mut self) -> Result<M, NotAccepted> {
        read(&mem::take(&mut self.payload))
    }

    pub fn reply<M: Message>(self, message: &M) {
        match encode(message) {
            Ok(bytes) => self.send(bytes.into()),
            Err(error) => self.send_error(&error.to_string()),
        }
    }

    /// Sends an answer that is already encoded.
    pub fn send(self, bytes: ZBytes) {
        let key = self.query.key_expr().clone();
        if let Err(error) = self.query.reply(key, bytes).wait() {
            debug!(%error, "an answer could not be sent");
        }
    }

    /// Counts the query as not accepted, and answers with the reason.
    pub fn reject(self, why: &NotAccepted, metrics: &Metrics) {
        debug!(%why, "a message was not accepted");
        metrics.reject(why.label());
        self.send_error(&why.to_string());
    }

    pub fn send_error(self, text: &str) {
        if let Err(error) = self.query.reply_err(text).wait() {
            debug!(%error, "an error could not be sent");
        }
    }
}

/// The message in a payload.
pub(super) fn read<M: Message>(payload: &ZBytes) -> Result<M, NotAccepted> {
    match payload.len() {
        0 => Err(NotAccepted::Empty),
        1..=MOST_BYTES => Ok(decode(&payload.to_bytes())?),
        _ => Err(NotAccepted::Oversized),
    }
}

/// A reason not to accept a message.
#[derive(Debug, thiserror::Error)]
pub(crate) enum NotAccepted {
    #[error("the message is empty")]
    Empty,
    #[error("the message is too large")]
    Oversized,
    #[error("the message cannot be read: {0}")]
    Codec(#[from] CodecError),
    #[error("there is no snapshot of that step")]
    NoSnapshot,
    #[error("the snapshot cannot be read: {0:#}")]
    Unreadable(anyhow::Error),
}

impl NotAccepted {
    /// The reason as a metric's label.
    pub fn label(&self) -> &'static str {
        match self {
            Self::Empty => "empty",
            Self::Oversized => "oversized",
            Self::Codec(error) => error.label(),
            Self::NoSnapshot => "unknown_step",
            Self::Unreadable(_) => "unreadable_snapshot",
        }
    }
}
