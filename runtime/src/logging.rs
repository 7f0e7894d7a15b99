//! Log lines of a program.

use std::env;
use std::io::{self, IsTerminal, Write};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use tracing::{Level, Subscriber};
use tracing_appender::non_blocking::{NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::filter::dynamic_filter_fn;
use tracing_subscriber::prelude::*;
use tracing_subscriber::{EnvFilter, fmt, registry};

/// The default of RUST_LOG: our own progress and Zenoh's warnings, without two of its messages: that
/// scouting by gossip is off, which is intended; and that it cannot listen or connect, which this
/// program reports itself.
const DEFAULT_FILTER: &str =
    "info,zenoh=warn,zenoh::net::routing::hat::peer=error,zenoh::net::runtime::orchestrator=error";

/// Most lines of Zenoh in a minute: it writes a line for each client that it refuses, so a stranger
/// could fill the disk. Our own lines about strangers have the level `debug`.
const ZENOH_LINES: u32 = 100;
const MINUTE: Duration = Duration::from_secs(60);

/// Lines that may wait for a reader of stderr; further lines are lost.
const MOST_WAITING: usize = 10_000;

/// Writes log lines until it is dropped; then it writes the waiting lines, for at most a second.
#[must_use]
pub struct Logging {
    _writer: WorkerGuard,
}

/// Sends log lines to stderr, in color on a terminal with colors unless NO_COLOR is set. The
/// environment variable RUST_LOG chooses the lines. If stderr is not read, only the log's own
/// thread waits. Call it first in `main`; further calls do nothing.
pub fn init_logging() -> Logging {
    let writer =
        NonBlockingBuilder::default().buffered_lines_limit(MOST_WAITING).thread_name("log");
    let (lines, guard) = writer.finish(std::io::stderr());
    let filter = match env::var_os(EnvFilter::DEFAULT_ENV) {
        // Says on stderr which parts it ignores.
        Some(_) => EnvFilter::from_default_env(),
        None => EnvFilter::new(DEFAULT_FILTER),
    };
    let variable = |name| env::var_os(name).unwrap_or_default();
    let colors = std::io::stderr().is_terminal()
        && variable("NO_COLOR").is_empty()
        && variable("TERM") != "dumb";
    subscriber(move || lines.clone(), filter, colors).try_init().ok();
    Logging { _writer: guard }
}

/// Writes lines without control characters but those of our colors: the formatter has escaped the
/// others with which terminals' commands begin.
struct Clean<W>(W);

impl<W: Write> Write for Clean<W> {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        let is_command = |byte: u8| byte < b' ' && !matches!(byte, b'\n' | b'\t' | b'\x1b');
        let clean = line.iter().map(|&byte| if is_command(byte) { b' ' } else { byte });
        self.0.write_all(&Vec::from_iter(clean))?;
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

fn subscriber<W: Write + 'static>(
    writer: impl Fn() -> W + Send + Sync + 'static,
    filter: EnvFilter,
    colors: bool,
) -> impl Subscriber + Send + Sync + 'static {
    let minute = Mutex::new((Instant::now(), 0));
    let bounded = dynamic_filter_fn(move |metadata, _| {
        let counts = metadata.target().starts_with("zenoh") && *metadata.level() <= Level::INFO;
        !counts || has_room(&minute, Instant::now())
    });
    let lines =
        fmt::layer().with_target(false).with_writer(move || Clean(writer())).with_ansi(colors);
    let lines = lines.with_filter(bounded);
    registry().with(lines).with(filter)
}

/// Counts a line of Zenoh in the minute that began at the first value.
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

    #[derive(Clone, Default)]
    struct Page(Arc<Mutex<Vec<u8>>>);

    impl Write for Page {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// The lines of some events.
    fn logged(filter: &str, events: impl FnOnce()) -> String {
        let page = Page::default();
        let writer = page.clone();
        let subscriber = subscriber(move || writer.clone(), EnvFilter::new(filter), false);
        tracing::subscriber::with_default(subscriber, events);
        String::from_utf8(page.0.lock().unwrap().clone()).unwrap()
    }

    #[test]
    fn control_characters_are_removed() {
        let characters = String::from_iter((0..0xa0).filter_map(char::from_u32));
        let text = logged("info", || info!(name = characters, "{characters}"));
        assert!(!text.contains(|c: char| c.is_control() && !matches!(c, '\n' | '\t')), "{text:?}");
    }

    #[test]
    fn refused_clients_do_not_fill_the_log_or_hide_our_lines() {
        let text = logged("debug", || {
            for text in std::iter::repeat_n("evaluator left", 1000).chain(["cannot be saved"]) {
                warn!(target: "zenoh_transport::unicast", "refused");
                debug!(target: "zenoh_transport::unicast", "asked for");
                info!("{text}");
            }
        });
        let count = |what: &str| text.lines().filter(|line| line.contains(what)).count();
        assert_eq!((count("left"), count("cannot be saved"), count("asked for")), (1000, 1, 1001));
        assert_eq!(count("refused"), ZENOH_LINES as usize);
    }

    #[test]
    fn each_minute_has_its_own_limit() {
        let begin = Instant::now();
        let minute = Mutex::new((begin, ZENOH_LINES));
        assert!(!has_room(&minute, begin + MINUTE / 2));
        assert!(has_room(&minute, begin + MINUTE));
    }
}
