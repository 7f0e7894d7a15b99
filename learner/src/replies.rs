//! The threads that answer queries. To send an answer may take until the peer reads, or up to two seconds, after which Zenoh
//! closes the connection; even to drop a query says "no more answers" to the peer. So neither happens on the threads that own
//! the state, nor on Zenoh's own: they only put their answers into this bounded queue.
//!
//! It is shared fairly among those who ask, as far as they can be told apart: by the names that they give. Whoever gives none
//! shares a place with all others who do not. (One who gives many names can take all places, for two seconds with each
//! connection; against that only access control helps.)
//!
//! What is left is Zenoh's own: when it closes the connection of a peer that is still being sent to, one of its two sending
//! threads waits for that sender, and whoever that thread was about to send to waits with it, two seconds or four. With several
//! such peers at once, all others do.

mod question;

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use quad_protocol::Name;
use quad_service::stay_in_background;
use zenoh::bytes::ZBytes;
use zenoh::query::Query;

use crate::hub;
use crate::inbox::Inbox;
use crate::metrics::Metrics;
use crate::threads::spawn_for_hub;

pub use question::Question;
use question::kept;

/// Threads that answer, and how many of them may read from the disk at a time: should it hang, the others go on.
const THREADS: usize = 12;
const MOST_READING: usize = 4;
/// A query is dropped so long after its answer: Zenoh's own thread still holds it while it hands it over, and whoever drops it
/// last may have to wait for the peer.
const GRACE: Duration = Duration::from_millis(50);
/// And this much later, if no thread is awake before: nobody waits for that, and to wake one takes longer.
const LATER: Duration = Duration::from_millis(500);
/// Most answers that may wait: of all, of one of those who ask, and queries that are only dropped, which take no room.
const MOST_WAITING: usize = 4096;
const MOST_WAITING_OF_ONE: usize = 64;
const MOST_DROPPED: usize = 256;
/// And what their queries may keep in memory together, bytes.
const MOST_BYTES_WAITING: usize = 16 << 20;

/// Who gets an answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Asker {
    /// An evaluator, by the name that it gives.
    Evaluator(Name),
    /// Whoever gives no name, or sent something that is refused.
    Stranger,
    /// Whoever gets no answer.
    Nobody,
}

impl Asker {
    /// How many threads may be busy with its answers at a time.
    fn most_threads(&self) -> usize {
        match self {
            Self::Evaluator(_) => 2,
            Self::Stranger => 2,
            Self::Nobody => 1,
        }
    }
}

/// An answer: the key and the message, or an error for people.
pub type Answer = Result<(String, ZBytes), String>;

/// What makes an answer and sends it.
type Work = Box<dyn FnOnce(&Query) + Send>;

struct Task {
    asker: Asker,
    query: Query,
    /// What the query keeps in memory.
    bytes: usize,
    /// If there is none any more, the query is only to be dropped.
    work: Option<Work>,
    /// Whether the answer is read from the disk.
    reads: bool,
    not_before: Instant,
}

impl Task {
    fn answer(asker: Asker, query: Query, work: Work, reads: bool) -> Self {
        Self { asker, bytes: kept(&query), query, work: Some(work), reads, not_before: Instant::now() }
    }

    fn drop_later(asker: Asker, query: Query) -> Self {
        Self { asker, bytes: kept(&query), query, work: None, reads: false, not_before: Instant::now() + GRACE }
    }
}

#[derive(Default)]
struct State {
    waiting: VecDeque<Task>,
    /// Of the answers that are being sent.
    busy: Vec<Asker>,
    /// How many of them are being read from the disk.
    reading: usize,
    /// Threads that sleep until they are called.
    asleep: usize,
    /// One was called, and will look at all that waits.
    called: bool,
    /// One sleeps for so long only: for queries that may be dropped then, and for what a thread that waits for its peer has
    /// left.
    timed: Option<Duration>,
    /// Nothing more will be put in.
    finishing: bool,
    closed: bool,
}

impl State {
    /// The first that may be worked on now.
    fn next(&self) -> Option<usize> {
        let now = Instant::now();
        self.waiting.iter().position(|task| {
            let threads = self.busy.iter().filter(|asker| **asker == task.asker).count();
            let may_read = !task.reads || self.reading < MOST_READING;
            threads < task.asker.most_threads() && may_read && (task.not_before <= now || self.closed)
        })
    }

    /// Whether a thread has to be called for a new task. To wake one costs more than to send an answer, so one is not if
    /// another will come by.
    fn calls(&mut self) -> bool {
        let all_asleep = self.asleep + usize::from(self.timed.is_some()) == THREADS;
        let calls = !self.called && (all_asleep || self.timed != Some(GRACE));
        self.called |= calls;
        calls
    }
}

struct Shared {
    state: Mutex<State>,
    /// There is something to send, for one of the threads.
    work: Condvar,
    /// Everything is sent.
    idle: Condvar,
    metrics: Metrics,
}

/// Reaches the threads. They end when [`finish`](Self::finish) was called or the last clone is dropped.
#[derive(Clone)]
pub struct Replies {
    shared: Arc<Shared>,
    _last: Arc<CloseOnDrop>,
}

struct CloseOnDrop(Arc<Shared>);

impl Drop for CloseOnDrop {
    fn drop(&mut self) {
        self.0.lock().closed = true;
        self.0.work.notify_all();
    }
}

impl Replies {
    /// Starts the threads. If one of them panics, the hub is told that the run cannot go on.
    pub fn start(metrics: &Metrics, hub: &Inbox<hub::Event>) -> std::io::Result<Self> {
        let (work, idle) = (Condvar::new(), Condvar::new());
        let shared = Arc::new(Shared { state: Mutex::default(), work, idle, metrics: metrics.clone() });
        for _ in 0..THREADS {
            let shared = shared.clone();
            spawn_for_hub("reply", hub, move || shared.work())?;
        }
        Ok(Self { _last: Arc::new(CloseOnDrop(shared.clone())), shared })
    }

    /// Waits until everything that was put in is sent, up to `patience`; a peer that does not read cannot make it longer.
    pub fn finish(&self, patience: Duration) {
        let deadline = Instant::now() + patience;
        let mut state = self.shared.lock();
        state.finishing = true;
        self.shared.work.notify_all();
        while !(state.waiting.is_empty() && state.busy.is_empty()) {
            let Some(left) = deadline.checked_duration_since(Instant::now()) else { break };
            let waited = self.shared.idle.wait_timeout(state, left);
            state = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn put(&self, task: Task) {
        let mut state = self.shared.lock();
        let of_one = state.waiting.iter().filter(|waiting| waiting.asker == task.asker).count();
        let most = if task.asker == Asker::Nobody { MOST_DROPPED } else { MOST_WAITING_OF_ONE };
        let bytes = state.waiting.iter().map(|waiting| waiting.bytes).sum::<usize>() + task.bytes;
        if state.waiting.len() < MOST_WAITING && of_one < most && bytes <= MOST_BYTES_WAITING {
            state.waiting.push_back(task);
            if state.calls() {
                drop(state);
                self.shared.work.notify_one();
            }
            return;
        }
        drop(state);
        let Task { asker, query, .. } = task;
        self.shared.metrics.reject("busy");
        match asker {
            // The end of the road: whoever floods us with questions and does not read now waits here itself.
            Asker::Nobody => drop(query),
            _ => self.put(Task::drop_later(Asker::Nobody, query)),
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn work(&self) {
        stay_in_background();
        let mut state = self.lock();
        loop {
            state.called = false;
            let next = state.next().and_then(|place| state.waiting.remove(place));
            let Some(Task { asker, query, work, reads, .. }) = next else {
                if state.closed {
                    return;
                }
                if state.waiting.is_empty() && state.busy.is_empty() {
                    self.idle.notify_all();
                }
                if state.waiting.is_empty() || state.timed.is_some() {
                    state.asleep += 1;
                    state = self.work.wait(state).unwrap_or_else(PoisonError::into_inner);
                    state.asleep -= 1;
                } else {
                    let answers = state.waiting.iter().any(|task| task.work.is_some());
                    let patience = if answers || !state.busy.is_empty() || state.finishing { GRACE } else { LATER };
                    state.timed = Some(patience);
                    state = self.work.wait_timeout(state, patience).unwrap_or_else(PoisonError::into_inner).0;
                    state.timed = None;
                }
                continue;
            };
            state.busy.push(asker.clone());
            state.reading += usize::from(reads);
            // What comes next does not wait for this one's peer.
            if state.next().is_some() && state.calls() {
                self.work.notify_one();
            }
            drop(state);
            let answered = match work {
                Some(work) => {
                    work(&query);
                    Some(Task::drop_later(asker.clone(), query))
                }
                None => {
                    drop(query);
                    None
                }
            };
            state = self.lock();
            state.reading -= usize::from(reads);
            state.waiting.extend(answered);
            if let Some(place) = state.busy.iter().position(|other| *other == asker) {
                state.busy.swap_remove(place);
            }
        }
    }
}
