//! Holds back connections that send too much.
//!
//! Zenoh takes in whatever comes, and each message takes time of a processor that training may need. A callback runs in the
//! task that reads its connection: while it waits, nothing else is read from there, and TCP makes the sender wait. Other
//! connections are read by other tasks.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use prometheus::Counter;
use tokio::task::{self, Id};

/// A connection may send a message this often in the long run. An evaluator sends a few in a second.
const INTERVAL: Duration = Duration::from_millis(5);
/// And so many at once.
const BURST: u32 = 400;
/// Whoever sends more is held back for so long, for several messages together.
const PAUSE: Duration = Duration::from_millis(50);
/// Most connections that are held back at a time: each takes one of the 50 threads that Zenoh's runtime may start.
const MOST_HELD_BACK: usize = 32;
/// Most connections that are kept account of. Those that are quiet for two seconds are forgotten.
const MOST_CONNECTIONS: usize = 4096;

/// Who has sent how much.
#[derive(Debug)]
pub(super) struct FloodGuard {
    accounts: Mutex<Accounts>,
    held_back: AtomicUsize,
    seconds: Counter,
    ended: AtomicBool,
}

impl FloodGuard {
    /// Adds to `seconds` how long connections were held back.
    pub fn new(seconds: Counter) -> Self {
        Self { accounts: Mutex::default(), held_back: AtomicUsize::new(0), seconds, ended: AtomicBool::new(false) }
    }

    /// Counts one that makes as much work as so many messages.
    pub fn messages(&self, count: u32) {
        (0..count).for_each(|_| self.message());
    }

    /// Counts a message of the connection whose task this is called in, and waits if there were too many.
    pub fn message(&self) {
        if self.ended.load(Ordering::Relaxed) {
            return;
        }
        // Messages from this process come on other threads, in no task of Zenoh's.
        let Some(connection) = task::try_id() else { return };
        let too_many = self.accounts.lock().unwrap_or_else(PoisonError::into_inner).message(connection, Instant::now());
        if !too_many {
            return;
        }
        if self.held_back.fetch_add(1, Ordering::Relaxed) < MOST_HELD_BACK {
            // Lets another thread read the other connections meanwhile.
            task::block_in_place(|| thread::sleep(PAUSE));
            self.seconds.inc_by(PAUSE.as_secs_f64());
        }
        self.held_back.fetch_sub(1, Ordering::Relaxed);
    }

    /// From now on nobody is held back, so that connections can be closed at once.
    pub fn end(&self) {
        self.ended.store(true, Ordering::Relaxed);
    }
}

/// When each connection would have sent what it has, had it kept to the interval.
#[derive(Debug, Default)]
struct Accounts(HashMap<Id, Instant>);

impl Accounts {
    /// Counts a message, and tells whether its connection is to wait.
    fn message(&mut self, connection: Id, now: Instant) -> bool {
        if self.0.len() >= MOST_CONNECTIONS && !self.0.contains_key(&connection) {
            self.0.retain(|_, due| *due > now);
            if self.0.len() >= MOST_CONNECTIONS {
                return false;
            }
        }
        let due = self.0.entry(connection).or_insert(now);
        let latest = now + BURST * INTERVAL + PAUSE;
        *due = ((*due).max(now) + INTERVAL).min(latest);
        *due == latest
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tokio::runtime::{Builder, Runtime};

    use super::*;

    /// As Zenoh's, but with as many threads on every machine.
    fn runtime() -> Runtime {
        Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap()
    }

    fn guard() -> Arc<FloodGuard> {
        Arc::new(FloodGuard::new(Counter::new("seconds", "held back").unwrap()))
    }

    /// How long a connection takes to get this many messages through.
    async fn send(guard: &Arc<FloodGuard>, count: u32) -> Duration {
        let (guard, begin) = (guard.clone(), Instant::now());
        let connection = tokio::spawn(async move { (0..count).for_each(|_| guard.message()) });
        connection.await.unwrap();
        begin.elapsed()
    }

    /// Ends floods although a test fails: the runtime waits for them.
    struct End(Arc<FloodGuard>);

    impl Drop for End {
        fn drop(&mut self) {
            self.0.end();
        }
    }

    /// A connection that floods until the guard's end.
    fn flood(guard: &Arc<FloodGuard>) -> tokio::task::JoinHandle<()> {
        let guard = guard.clone();
        tokio::spawn(async move {
            while !guard.ended.load(Ordering::Relaxed) {
                guard.message();
            }
        })
    }

    #[test]
    fn a_hundred_messages_too_many_take_half_a_second() {
        let id = Runtime::new().unwrap().block_on(async { tokio::spawn(async {}).id() });
        let (mut accounts, begin) = (Accounts::default(), Instant::now());
        let held_back = |accounts: &mut Accounts, count, at| -> u32 {
            (0..count).map(|_| u32::from(accounts.message(id, at))).sum()
        };
        assert_eq!(held_back(&mut accounts, BURST, begin), 0, "so much is not too much");
        let mut now = begin;
        for _ in 0..100 {
            now += PAUSE * held_back(&mut accounts, 1, now);
        }
        assert_eq!(now - begin, Duration::from_millis(500));
    }

    #[test]
    fn a_connection_that_floods_waits_and_others_do_not() {
        runtime().block_on(async {
            let guard = guard();
            let _end = End(guard.clone());
            send(&guard, BURST).await;
            assert_eq!(guard.seconds.get(), 0.0, "so much is not too much");
            let (begin, flood) = (Instant::now(), flood(&guard));
            // A machine may stand still meanwhile, but not each time.
            let mut others = Vec::new();
            while others.len() < 10 || guard.seconds.get() < 0.4 {
                assert!(begin.elapsed() < Duration::from_secs(30), "{} s held back", guard.seconds.get());
                others.push(send(&guard, BURST).await);
                tokio::time::sleep(PAUSE / 5).await;
            }
            let held_back = guard.seconds.get();
            assert!(begin.elapsed().as_secs_f64() > 0.99 * held_back, "it was counted, but it did not wait");
            let best = *others.iter().min().unwrap();
            assert!(best < PAUSE / 2, "somebody else took {best:?}");
            guard.end();
            flood.await.unwrap();
            let held_back = guard.seconds.get();
            send(&guard, 2 * BURST).await;
            assert_eq!(guard.seconds.get(), held_back, "at the end nobody waits");
        });
    }

    #[test]
    fn many_that_flood_leave_threads_for_the_others() {
        let (runtime, guard) = (runtime(), guard());
        let _end = End(guard.clone());
        let (mut most, begin) = (0, Instant::now());
        let floods: Vec<_> = runtime.block_on(async { (0..2 * MOST_HELD_BACK).map(|_| flood(&guard)).collect() });
        // More than there are threads, and each that may wait has done so several times.
        while most <= 2 || guard.seconds.get() < 4.0 * MOST_HELD_BACK as f64 * PAUSE.as_secs_f64() {
            most = most.max(guard.held_back.load(Ordering::Relaxed));
            assert!(begin.elapsed() < Duration::from_secs(30), "{most} at a time");
            thread::sleep(Duration::from_millis(1));
        }
        let at_a_time = guard.seconds.get() / begin.elapsed().as_secs_f64();
        assert!(at_a_time <= MOST_HELD_BACK as f64, "{at_a_time} at a time");
        guard.end();
        for flood in floods {
            runtime.block_on(flood).unwrap();
        }
    }

    #[test]
    fn accounts_of_quiet_connections_are_closed() {
        let (mut accounts, now) = (Accounts::default(), Instant::now());
        let ids: Vec<Id> = Runtime::new()
            .unwrap()
            .block_on(async { (0..MOST_CONNECTIONS + 1).map(|_| tokio::spawn(async {}).id()).collect() });
        for &id in &ids {
            assert!(!accounts.message(id, now));
        }
        assert_eq!(accounts.0.len(), MOST_CONNECTIONS, "the last has no account");
        accounts.message(ids[MOST_CONNECTIONS], now + INTERVAL);
        assert_eq!(accounts.0.len(), 1);
    }
}
