//! Threads that answer queries. An answer may block until the peer reads, or for up to two seconds, after which Zenoh closes
//! the connection; so only threads on which no others wait send answers. The queue for these threads is bounded.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

use quad_runtime::stay_in_background;

use super::events::Events;
use super::spawn::spawn;

type Task = Box<dyn FnOnce() + Send>;

/// A handle to the threads. They end when the last clone is dropped.
#[derive(Clone)]
pub(super) struct Pool {
    tasks: SyncSender<Task>,
}

impl Pool {
    /// Starts the threads, with a queue of limited length.
    pub fn start(name: &'static str, threads: usize, most_waiting: usize, events: &Events) -> std::io::Result<Self> {
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

/// Waits for the next task; `None` when no more can come. One thread waits on the queue, the others on its lock.
fn next(waiting: &Mutex<Receiver<Task>>) -> Option<Task> {
    waiting.lock().unwrap_or_else(PoisonError::into_inner).recv().ok()
}
