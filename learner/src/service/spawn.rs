//! How a thread of a run is started.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread::{self, JoinHandle};

use anyhow::anyhow;
use quad_service::Beat;
use tracing::debug;

use super::events::{Event, Events};

/// Starts a thread that says that it is alive, and when it is done. If it panics its health says so.
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

/// Starts a thread. If it fails or panics, the main loop is told, and the run ends: without it the process would look alive
/// and do nothing.
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
mod tests {
    use std::time::Duration;

    use quad_service::Health;
    use tokio::sync::mpsc::unbounded_channel;

    use super::*;

    #[test]
    fn a_thread_that_fails_or_panics_tells_the_main_loop_why() {
        let (events, mut told) = unbounded_channel();
        let mut failed = |work: fn() -> anyhow::Result<()>| {
            spawn("scores", &events, work).unwrap().join().unwrap();
            match told.try_recv() {
                Ok(Event::Failed(error)) => error.to_string(),
                other => panic!("{other:?}"),
            }
        };
        let panicked = failed(|| panic!("a test's own {}", "panic"));
        assert!(panicked.contains("`scores` panicked") && panicked.contains("a test's own panic"), "{panicked}");
        assert_eq!(failed(|| Err(anyhow!("no such thing"))), "no such thing");

        let health = Health::default();
        let beat = health.part("scores", Duration::from_secs(60));
        spawn_alive("scores", &events, beat, |_| panic!("again")).unwrap().join().unwrap();
        assert_eq!(health.problems().len(), 1);
        spawn("scores", &events, || Ok(())).unwrap().join().unwrap();
        assert!(matches!(told.try_recv(), Ok(Event::Failed(_))) && told.try_recv().is_err());
    }
}
