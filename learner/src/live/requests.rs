//! A Zenoh query that waits for its answer.

use std::mem;

use quad_protocol::{Message, decode, encode};
use tracing::debug;
use zenoh::Wait;
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use super::metrics::Metrics;
use super::rejection::Rejection;

/// Largest message to the learner, bytes; a score report of the largest job has 1.4 KB. A learner that listens receives no
/// fragmented messages, which begin at 32,700 bytes at the earliest.
const MOST_BYTES: usize = 30 * 1024;

/// A query and its message.
pub(super) struct Request {
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

    /// The query's key.
    pub fn key(&self) -> &str {
        self.query.key_expr().as_str()
    }

    /// The query's message; the request does not keep it.
    pub fn message<M: Message>(&mut self) -> Result<M, Rejection> {
        read(&mem::take(&mut self.payload))
    }

    /// Sends an answer.
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
    pub fn reject(self, rejection: &Rejection, metrics: &Metrics) {
        debug!(%rejection, "a message was not accepted");
        metrics.reject(rejection.label());
        self.send_error(&rejection.to_string());
    }

    fn send_error(self, text: &str) {
        if let Err(error) = self.query.reply_err(text).wait() {
            debug!(%error, "an error could not be sent");
        }
    }
}

/// The message in a payload.
pub(super) fn read<M: Message>(payload: &ZBytes) -> Result<M, Rejection> {
    match payload.len() {
        0 => Err(Rejection::Empty),
        1..=MOST_BYTES => Ok(decode(&payload.to_bytes())?),
        _ => Err(Rejection::Oversized),
    }
}

#[cfg(test)]
mod tests;
