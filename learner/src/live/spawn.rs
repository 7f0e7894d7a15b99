//! Starts threads: one, or several that answer queries. An answer may block until the peer reads,
//! or for up to two seconds, after which Zenoh closes the connection; so only threads on which no
//! others wait send answers. The queue for these threads is bounded.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use anyhow::anyhow;
use quad_runtime::{Heartbeat, stay_in_background};
use tracing::debug;

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
pub(super) fn spawn(
    name: &'static str,
    events: &Events,
    work: impl FnOnce() -> anyhow::Result<()> + Send + 'static,
) -> std::io::Result<JoinHandle<()>> {
    let events = events.clone();
    thread::Builder::new().name(name.to_owned()).spawn(move || {
        debug!(thread = name, "started");
        let ended = catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|payload| {
            let message = message(payload.as_ref());
            Err(anyhow!("the thread `{name}` panicked, which is a bug of this program: {message}"))
        });
        if let Err(error) = ended {
            events.send(Event::Failed(error)).ok();
        }
        debug!(thread = name, "ended");
    })
}

fn message(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| payload.downcast_ref::<String>().cloned()).unwrap_or_default()
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
        let (tasks, waiting) = sync_channel(most_waiting);
        let waiting = Arc::new(Mutex::new(waiting));
        for _ in 0..threads {
            let waiting = waiting.clone();
            spawn(name, events, move || {
                stay_in_background();
                while let Some(task) = next(&waiting) {
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

/// Waits for the next task; `None` when no more can come. One thread waits on the queue, the others
/// on its lock.
fn next(waiting: &Mutex<Receiver<Task>>) -> Option<Task> {
    waiting.lock().unwrap_or_else(PoisonError::into_inner).recv().ok()
}

#[cfg(test)]
mod tests;
