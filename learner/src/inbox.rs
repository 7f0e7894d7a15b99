//! A queue from Zenoh's threads to the thread that owns the state. A callback that worked or waited would delay every
//! other key of the connection, so it only puts the message into this queue, which refuses it when it is full.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, Sender};
use std::time::Duration;

/// Most messages from the network that may wait, and their sizes together, bytes. There is room for a question and a
/// progress message of every evaluator while the disk takes its time.
const MOST_WAITING: usize = 4096;
const MOST_BYTES_WAITING: usize = 64 << 20;
/// The same for what Zenoh itself tells of who comes and goes, which takes little room and is not sent again.
const MOST_CHANGES_WAITING: usize = 4096;
/// Largest message to the learner with all that comes with it, bytes; a score report of the largest job is 1.4 KB. A learner
/// that listens hears of none that Zenoh sends in several pieces, which begins at 32,700 bytes at the earliest.
pub const MOST_BYTES: usize = 30 * 1024;

/// The sending side. Clones share the bound.
#[derive(Debug)]
pub struct Inbox<T> {
    sender: Sender<Envelope<T>>,
    waiting: Arc<Waiting>,
}

#[derive(Debug, Default)]
struct Waiting {
    messages: AtomicUsize,
    bytes: AtomicUsize,
    changes: AtomicUsize,
}

#[derive(Clone, Copy, Debug)]
enum Source {
    Process,
    /// With its size, bytes.
    Message(usize),
    Change,
}

impl Waiting {
    /// Whether there is room; if so, it is taken.
    fn enter(&self, source: Source) -> bool {
        let take = |count: &AtomicUsize, size: usize, most: usize| {
            let fits = count.fetch_add(size, Ordering::Relaxed) + size <= most;
            if !fits {
                count.fetch_sub(size, Ordering::Relaxed);
            }
            fits
        };
        match source {
            Source::Process => true,
            Source::Change => take(&self.changes, 1, MOST_CHANGES_WAITING),
            Source::Message(size) => {
                let counted = take(&self.messages, 1, MOST_WAITING);
                let fits = counted && take(&self.bytes, size, MOST_BYTES_WAITING);
                if counted && !fits {
                    self.messages.fetch_sub(1, Ordering::Relaxed);
                }
                fits
            }
        }
    }

    fn leave(&self, source: Source) {
        match source {
            Source::Process => {}
            Source::Change => drop(self.changes.fetch_sub(1, Ordering::Relaxed)),
            Source::Message(size) => {
                self.messages.fetch_sub(1, Ordering::Relaxed);
                self.bytes.fetch_sub(size, Ordering::Relaxed);
            }
        }
    }
}

// Not derived, because that would ask for `T: Clone`.
impl<T> Clone for Inbox<T> {
    fn clone(&self) -> Self {
        Self { sender: self.sender.clone(), waiting: self.waiting.clone() }
    }
}

/// The receiving side.
#[derive(Debug)]
pub struct Messages<T> {
    receiver: Receiver<Envelope<T>>,
    waiting: Arc<Waiting>,
}

#[derive(Debug)]
struct Envelope<T> {
    message: T,
    source: Source,
}

/// A queue that is bounded for messages from the network.
pub fn inbox<T>() -> (Inbox<T>, Messages<T>) {
    let (sender, receiver) = mpsc::channel();
    let waiting = Arc::new(Waiting::default());
    (Inbox { sender, waiting: waiting.clone() }, Messages { receiver, waiting })
}

impl<T> Inbox<T> {
    /// Sends a message from inside this process: always accepted, never blocks; lost if the receiver is gone.
    pub fn send(&self, message: T) {
        self.sender.send(Envelope { message, source: Source::Process }).ok();
    }

    /// Sends a message from the network that has `bytes`; gives it back if too many wait already. Never blocks.
    pub fn offer(&self, message: T, bytes: usize) -> Result<(), T> {
        self.offer_from(Source::Message(bytes), message)
    }

    /// The same for a change of who is connected.
    pub fn offer_change(&self, message: T) -> Result<(), T> {
        self.offer_from(Source::Change, message)
    }

    fn offer_from(&self, source: Source, message: T) -> Result<(), T> {
        if !self.waiting.enter(source) {
            return Err(message);
        }
        self.sender.send(Envelope { message, source }).map_err(|unsent| unsent.0.message)
    }
}

impl<T> Messages<T> {
    /// The next message, or `None` after `timeout`, or `Disconnected` when nobody can send any more.
    pub fn next(&self, timeout: Duration) -> Result<Option<T>, Disconnected> {
        match self.receiver.recv_timeout(timeout) {
            Ok(envelope) => {
                self.waiting.leave(envelope.source);
                Ok(Some(envelope.message))
            }
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(Disconnected),
        }
    }
}

/// Every [`Inbox`] of the queue was dropped: no message can come any more.
#[derive(Debug, PartialEq, Eq)]
pub struct Disconnected;

#[cfg(test)]
mod tests {
    use quad_protocol::{EpisodeScore, Hash, Name, ScoreReport, encode};

    use super::*;

    #[test]
    fn strangers_cannot_fill_the_queue_but_the_process_gets_through() {
        let (inbox, messages) = inbox();
        let offered = |bytes| (0..MOST_WAITING + 10).filter(|&n| inbox.offer(n, bytes).is_ok()).count();
        assert_eq!(offered(100), MOST_WAITING);
        inbox.send(7777);
        let received: Vec<_> = std::iter::from_fn(|| messages.next(Duration::ZERO).unwrap()).collect();
        assert_eq!(received.len(), MOST_WAITING + 1);
        assert_eq!(received.last(), Some(&7777));
        assert_eq!(offered(MOST_BYTES), MOST_BYTES_WAITING / MOST_BYTES, "large ones are fewer");
        assert_eq!(
            std::iter::from_fn(|| messages.next(Duration::ZERO).unwrap()).count(),
            MOST_BYTES_WAITING / MOST_BYTES
        );
        let changes = (0..MOST_CHANGES_WAITING + 10).filter(|&n| inbox.offer_change(n).is_ok()).count();
        assert_eq!(changes, MOST_CHANGES_WAITING);
        assert_eq!(std::iter::from_fn(|| messages.next(Duration::ZERO).unwrap()).count(), changes);
        assert_eq!(offered(0), MOST_WAITING, "there is room again");
        drop(inbox);
        assert_eq!(std::iter::from_fn(|| messages.next(Duration::ZERO).ok().flatten()).count(), MOST_WAITING);
        assert_eq!(messages.next(Duration::ZERO), Err(Disconnected));
    }

    #[test]
    fn an_honest_message_is_far_from_too_large() {
        let longest = Name::new("n".repeat(Name::MAX_LENGTH)).unwrap();
        let episode = EpisodeScore { seed: 1, episode_return: 1.0, length: 1, score: 1.0 };
        let report = ScoreReport {
            evaluator: longest.clone(),
            run: longest.clone(),
            incarnation: 1,
            job: 1,
            step: 1,
            weights: Hash::of(b"weights"),
            precision: longest,
            episodes: vec![episode; 256], // more than an evaluator would do
        };
        assert!(encode(&report).unwrap().len() < MOST_BYTES / 2);
    }
}
