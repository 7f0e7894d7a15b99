//! Starts the threads of a run.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread::{self, JoinHandle};

use anyhow::anyhow;
use quad_runtime::Beat;
use tracing::debug;

use super::events::{Event, Events};

/// Starts a thread that reports that it is alive, and when it is done. If it panics, `/healthz` says so.
pub(super) fn spawn_alive(
    name: &'static str,
    events: &Events,
    beat: Beat,
    work: impl FnOnce(&Beat) -> anyhow::Result<()> + Send + 'static,
) -> std::io::Result<JoinHandle<()>> {
    spawn(name, events, move || {
        work(&beat)?;
        beat.finish();
        Ok(())
    })
}

/// Starts a thread. If it fails or panics, the main loop ends the run: without that thread the process would look alive and do
/// nothing.
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

#[cfg(test)]
mod tests;
