//! Starts threads: one, or several that answer queries. An answer may block until the peer reads,
//! or for up to two seconds, after which Zenoh closes the connection; so only threads on which no
//! others wait send answers. The queue for these threads is bounded.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use anyhow::anyhow;
use quad_runtime::{Heartbeat, stay_in_background};

use super::events::{Event, Events};

/// Starts a thread that reports that it is alive, and when it is done. If it panics, `/healthz`
/// says so.
pub(super) fn spawn_alive(
    name: &'static str,
    events: &Events,
    beat: Heartbeat,
    work: impl FnOnce(&Heartbeat) -> anyhow::Result<()> + Send + 'static,
) -> std::io::Result<JoinHandle<()>> {
    spawn(name, events, move || {
        work(&beat)?;
        beat.finish();
        Ok(())
    })
}

/// Starts a thread. If it fails or panics, the main loop ends the run: without that thread the
/// process would look alive and do nothing.
fn spawn(
    name: &'static str,
    events: &Events,
    work: impl FnOnce() -> anyhow::Result<()> + Send + 'static,
) -> std::io::Result<JoinHandle<()>> {
    let events = events.clone();
    thread::Builder::new().name(name.to_owned()).spawn(move || {
        let panicked = |_| Err(anyhow!("the thread `{name}` panicked, which is a bug"));
        if let Err(error) = catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(panicked) {
            events.send(Event::Failed(error));
        }
    })
}

type Task = Box<dyn FnOnce() + Send>;

/// A handle to the threads. They end when the last clone is dropped.
#[derive(Clone)]
pub(super) struct Pool {
    tasks: SyncSender<Task>,
}

impl Pool {
    /// Starts the threads, with a queue of limited length.
    pub fn start(
        name: &'static str,
        threads: usize,
        most_waiting: usize,
        events: &Events,
    ) -> std::io::Result<Self> {
        let (tasks, rx) = sync_channel::<Task>(most_waiting);
        let rx = Arc::new(Mutex::new(rx));
        for _ in 0..threads {
            let rx = rx.clone();
            spawn(name, events, move || {
                stay_in_background();
                // One thread waits on the queue, the others on its lock.
                let next = || rx.lock().unwrap_or_else(PoisonError::into_inner).recv();
                while let Ok(task) = next() {
                    task();
                }
                Ok(())
            })?;
        }
        Ok(Self { tasks })
    }

    /// Queues a task; false if the queue is full. Never waits.
    pub fn give(&self, task: impl FnOnce() + Send + 'static) -> bool {
        self.tasks.try_send(Box::new(task)).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use quad_runtime::Health;
    use tokio::sync::mpsc::unbounded_channel;

    use super::*;

    #[test]
    fn a_thread_that_fails_or_panics_tells_the_main_loop_why() {
        let (tx, mut rx) = unbounded_channel();
        let (events, health) = (Events(tx), Health::default());
        for (work, expected) in [
            (
                (|_| panic!("on purpose")) as fn(&Heartbeat) -> _,
                "the thread `scores` panicked, which is a bug",
            ),
            (|_| Err(anyhow!("no such file")), "no such file"),
        ] {
            let beat = health.register("scores", Duration::from_secs(60));
            spawn_alive("scores", &events, beat, work).unwrap().join().unwrap();
            assert!(
                matches!(rx.try_recv(), Ok(Event::Failed(error)) if error.to_string() == expected)
            );
        }
        assert_eq!(health.problems().len(), 2);
        spawn("scores", &events, || Ok(())).unwrap().join().unwrap();
        assert!(rx.try_recv().is_err());
    }
}
