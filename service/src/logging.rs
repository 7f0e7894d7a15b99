//! Which log lines are written, and where to.

use std::env;
use std::io::IsTerminal;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use tracing::{Level, Subscriber};
use tracing_appender::non_blocking::{NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::filter::dynamic_filter_fn;
use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::prelude::*;
use tracing_subscriber::{EnvFilter, fmt, registry};

/// Without RUST_LOG: our own progress and Zenoh's complaints. `zenoh` is the prefix of all of its crates. One of its warnings
/// is left out: that scouting by gossip is off, which it is on purpose. So is what it says when it cannot listen or connect, which
/// is told in our own words.
const DEFAULT_FILTER: &str =
    "info,zenoh=warn,zenoh::net::routing::hat::peer=error,zenoh::net::runtime::orchestrator=error";

/// Most lines of Zenoh's in a minute. It writes one for each client that it refuses, so that a stranger could fill the disk.
/// Our own lines are not counted: what strangers send is logged at the level `debug`, which only RUST_LOG shows.
const ZENOH_LINES: u32 = 100;
const MINUTE: Duration = Duration::from_secs(60);

/// Lines that wait for a reader of stderr; later ones are lost.
const MOST_WAITING: usize = 10_000;

/// Writes log lines for as long as it lives. Dropped, it writes those that wait, but for no longer than a second.
#[must_use]
pub struct Logging {
    _writer: WorkerGuard,
}

/// Sends log lines to stderr, coloured on a terminal that has colours, unless NO_COLOR is set; the environment variable RUST_LOG chooses which. Only a thread of the
/// log's own waits when stderr is not read.
///
/// To be called once, first thing in `main`; further calls do nothing.
pub fn init_logging() -> Logging {
    let writer = NonBlockingBuilder::default().buffered_lines_limit(MOST_WAITING).thread_name("log");
    let (lines, guard) = writer.finish(std::io::stderr());
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(DEFAULT_FILTER));
    let variable = |name| env::var_os(name).unwrap_or_default();
    let colours = std::io::stderr().is_terminal() && variable("NO_COLOR").is_empty() && variable("TERM") != "dumb";
    subscriber(lines, filter, colours).try_init().ok();
    Logging { _writer: guard }
}

fn subscriber<W>(writer: W, filter: EnvFilter, colours: bool) -> impl Subscriber + Send + Sync + 'static
where
    W: for<'a> MakeWriter<'a> + Send + Sync + 'static,
{
    let minute = Mutex::new((Instant::now(), 0));
    let bounded = dynamic_filter_fn(move |metadata, _| {
        let counts = metadata.target().starts_with("zenoh") && *metadata.level() <= Level::INFO;
        !counts || has_room(&minute, Instant::now())
    });
    let lines = fmt::layer().with_target(false).with_writer(writer).with_ansi(colours).with_filter(bounded);
    registry().with(lines).with(filter)
}

/// Counts one more line of Zenoh's in the minute that began at the first value.
fn has_room(minute: &Mutex<(Instant, u32)>, now: Instant) -> bool {
    let (begin, count) = &mut *minute.lock().unwrap_or_else(PoisonError::into_inner);
    if now - *begin >= MINUTE {
        (*begin, *count) = (now, 0);
    }
    *count = count.saturating_add(1);
    *count <= ZENOH_LINES
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use tracing::{debug, info, warn};

    use super::*;

    #[test]
    fn refused_clients_do_not_fill_the_log_and_hide_nothing_of_ours() {
        let page = Arc::new(Mutex::new(Vec::new()));
        struct Page(Arc<Mutex<Vec<u8>>>);
        impl std::io::Write for Page {
            fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
                self.0.lock().unwrap().write(bytes)
            }

            fn flush(&mut self) -> std::io::Result<()> {
                Ok(())
            }
        }
        let writer = page.clone();
        let filter = EnvFilter::new("debug");
        tracing::subscriber::with_default(subscriber(move || Page(writer.clone()), filter, false), || {
            // All events of a learner come from one place in the code.
            for text in std::iter::repeat_n("evaluator left", 1000).chain(["the score cannot be saved"]) {
                warn!(target: "zenoh_transport::unicast", "refused");
                debug!(target: "zenoh_transport::unicast", "asked for");
                info!("{text}");
            }
        });
        let text = String::from_utf8(page.lock().unwrap().clone()).unwrap();
        let count = |what: &str| text.lines().filter(|line| line.contains(what)).count();
        assert_eq!((count("left"), count("cannot be saved"), count("asked for")), (1000, 1, 1001));
        assert_eq!(count("refused"), ZENOH_LINES as usize);
    }

    #[test]
    fn each_minute_begins_anew() {
        let begin = Instant::now();
        let minute = Mutex::new((begin, ZENOH_LINES));
        assert!(!has_room(&minute, begin + MINUTE / 2));
        assert!(has_room(&minute, begin + MINUTE));
    }
}
