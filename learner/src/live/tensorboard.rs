//! The thread `tensorboard`: copies the run's metrics and scores to TensorBoard's event file. No thread waits long for it.

use std::io;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::Duration;

use tracing::warn;

use crate::report::Exporter;

/// How often the thread copies.
const EVERY: Duration = Duration::from_secs(10);
/// How long the end of a run waits for the last copy, whose disk may hang.
const PATIENCE: Duration = Duration::from_secs(3);

/// The running thread.
pub(super) struct TensorBoard {
    /// Never sent to: the thread ends when this is dropped.
    stop: Sender<()>,
    /// Never received from: the thread drops the other end when it has ended.
    ended: Receiver<()>,
}

impl TensorBoard {
    /// Starts the thread.
    pub fn start(mut exporter: Exporter) -> io::Result<Self> {
        let (stop, stopped) = channel::<()>();
        let (ending, ended) = channel::<()>();
        let work = move || {
            let _ending = ending;
            let mut warned = false;
            let mut copy = || {
                if let Err(error) = exporter.append()
                    && !warned
                {
                    warned = true;
                    warn!("TensorBoard's event file cannot be written, which is tried again: {error:#}");
                }
            };
            copy();
            while stopped.recv_timeout(EVERY) == Err(RecvTimeoutError::Timeout) {
                copy();
            }
            copy();
        };
        thread::Builder::new().name("tensorboard".to_owned()).spawn(work)?;
        Ok(Self { stop, ended })
    }

    /// Ends the thread after a last copy.
    pub fn end(self) {
        drop(self.stop);
        if self.ended.recv_timeout(PATIENCE) == Err(RecvTimeoutError::Timeout) {
            warn!("TensorBoard's event file is not complete: its disk did not take the last copy");
        }
    }
}

#[cfg(test)]
mod tests;
