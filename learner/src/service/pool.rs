//! A few threads that answer queries. To send an answer may take until the peer reads, or up to two seconds, after which
//! Zenoh closes the connection; so no thread does it that others wait for. What waits for these threads is bounded.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

use quad_service::stay_in_background;

use super::events::Events;
use super::spawn::spawn;

type Task = Box<dyn FnOnce() + Send>;

/// Reaches the threads. They end when the last clone is dropped.
#[derive(Clone)]
pub(super) struct Pool {
    tasks: SyncSender<Task>,
}

impl Pool {
    /// Starts so many threads, for which so many tasks may wait.
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

    /// Leaves a task, unless too many wait already. Never waits.
    pub fn give(&self, task: impl FnOnce() + Send + 'static) -> bool {
        self.tasks.try_send(Box::new(task)).is_ok()
    }
}

/// The next task, as soon as there is one; nothing when none can come any more. One thread waits for it, the others for
/// that one.
fn next(waiting: &Mutex<Receiver<Task>>) -> Option<Task> {
    waiting.lock().unwrap_or_else(PoisonError::into_inner).recv().ok()
}
