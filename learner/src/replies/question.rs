//! A question that came in over Zenoh, until it is answered.

use std::mem;

use tracing::debug;
use zenoh::Wait;
use zenoh::bytes::{Encoding, ZBytes};
use zenoh::key_expr::KeyExpr;
use zenoh::query::Query;

use super::{Answer, Asker, Replies, Task};
use crate::inbox::MOST_BYTES;

/// What Zenoh receives at once, bytes; a part of it keeps all of it in memory.
const RECEIVE_BUFFER: usize = 64 << 10;

/// What a query keeps in memory besides its payload, bytes.
pub(super) fn kept(query: &Query) -> usize {
    let own_encoding = query.encoding().is_some_and(|encoding| *encoding != Encoding::default());
    let encoding = if own_encoding { RECEIVE_BUFFER } else { 0 };
    query.key_expr().as_str().len() + query.parameters().as_str().len() + encoding
}

/// A query that came in. It is answered, and also dropped, on a thread of [`Replies`].
pub struct Question {
    query: Option<Query>,
    message: Option<Vec<u8>>,
    bytes: usize,
    replies: Replies,
}

impl Question {
    /// A query that came in, to be answered by `replies`. Its message is copied, unless it is larger than [`MOST_BYTES`].
    pub fn new(mut query: Query, replies: &Replies) -> Self {
        let payload = query.payload_mut().map(mem::take);
        drop(query.attachment_mut().map(mem::take));
        let bytes = kept(&query) + payload.as_ref().map_or(0, ZBytes::len);
        let message = payload.filter(|_| bytes <= MOST_BYTES).map(|payload| payload.to_bytes().into_owned());
        Self { query: Some(query), message, bytes, replies: replies.clone() }
    }

    /// What it asks for.
    pub fn key(&self) -> Option<&KeyExpr<'static>> {
        self.query.as_ref().map(Query::key_expr)
    }

    /// What came with it, unless that is too large.
    pub fn message(&self) -> Option<&[u8]> {
        self.message.as_deref()
    }

    /// How large it is with everything that came with it, bytes.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Answers it.
    pub fn answer(self, asker: Asker, answer: Answer) {
        self.send(asker, move || answer, false);
    }

    /// Answers it with something that has to be read from the disk.
    pub fn answer_from_disk(self, asker: Asker, read: impl FnOnce() -> Answer + Send + 'static) {
        self.send(asker, read, true);
    }

    fn send(mut self, asker: Asker, answer: impl FnOnce() -> Answer + Send + 'static, reads: bool) {
        let send = move |query: &Query| {
            let sent = match answer() {
                Ok((key, bytes)) => query.reply(key, bytes).wait(),
                Err(text) => query.reply_err(text).wait(),
            };
            if let Err(error) = sent {
                debug!(%error, "an answer could not be sent");
            }
        };
        if let Some(query) = mem::take(&mut self.query) {
            self.replies.put(Task::answer(asker, query, Box::new(send), reads));
        }
    }
}

impl Drop for Question {
    fn drop(&mut self) {
        if let Some(query) = mem::take(&mut self.query) {
            self.replies.put(Task::drop_later(Asker::Nobody, query));
        }
    }
}

impl std::fmt::Debug for Question {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Question").field(&self.key()).finish()
    }
}
