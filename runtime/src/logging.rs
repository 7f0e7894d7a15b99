//! Which log lines a program writes, and where to.

use std::env;
use std::io::{self, IsTerminal, Write};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use tracing::{Level, Subscriber};
use tracing_appender::non_blocking::{NonBlockingBuilder, WorkerGuard};
use tracing_subscriber::filter::dynamic_filter_fn;
use tracing_subscriber::prelude::*;
use tracing_subscriber::{EnvFilter, fmt, registry};

/// The default of RUST_LOG: our own progress and Zenoh's warnings. `zenoh` is the prefix of all of
/// its crates. Two of its messages are left out: that scouting by gossip is off, which is intended;
/// and that it cannot listen or connect, which this program reports itself.
const DEFAULT_FILTER: &str =
    "info,zenoh=warn,zenoh::net::routing::hat::peer=error,zenoh::net::runtime::orchestrator=error";

/// Most lines of Zenoh in a minute. Zenoh writes a line for each client that it refuses, so a
/// stranger could fill the disk. Our own lines are not counted: messages of strangers are logged at
/// the level `debug`, which only RUST_LOG shows.
const ZENOH_LINES: u32 = 100;
const MINUTE: Duration = Duration::from_secs(60);

/// Lines that may wait for a reader of stderr; further lines are lost.
const MOST_WAITING: usize = 10_000;

/// Writes log lines as long as it lives. When it is dropped it writes the waiting lines, for at
/// most a second.
#[must_use]
pub struct Logging {
    _writer: WorkerGuard,
}

/// Sends log lines to stderr, in color on a terminal with colors unless NO_COLOR is set. The
/// environment variable RUST_LOG chooses the lines. If stderr is not read, only the log's own
/// thread waits.
///
/// Call it once, first in `main`; further calls do nothing.
pub fn init_logging() -> Logging {
    let writer =
        NonBlockingBuilder::default().buffered_lines_limit(MOST_WAITING).thread_name("log");
    let (lines, guard) = writer.finish(std::io::stderr());
    let filter =
        EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(DEFAULT_FILTER));
    let variable = |name| env::var_os(name).unwrap_or_default();
    let colors = std::io::stderr().is_terminal()
        && variable("NO_COLOR").is_empty()
        && variable("TERM") != "dumb";
    subscriber(move || lines.clone(), filter, colors).try_init().ok();
    Logging { _writer: guard }
}

/// Writes lines without control characters. The formatter has escaped those that terminals'
/// commands begin with; what has these in the end is our own, for colors.
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

/// Counts one more line of Zenoh in the minute that began at the first value.
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

    impl Page {
        fn text(&self) -> String {
            String::from_utf8(self.0.lock().unwrap().clone()).unwrap()
        }
    }

    impl Write for Page {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn what_is_logged_commands_no_terminal() {
        let page = Page::default();
        let writer = page.clone();
        tracing::subscriber::with_default(
            subscriber(move || writer.clone(), EnvFilter::new("info"), false),
            || {
                let all = String::from_iter((0..0xa0).filter_map(char::from_u32));
                info!(name = all, "{all}");
            },
        );
        let text = page.text();
        assert!(!text.contains(|c: char| c.is_control() && !matches!(c, '\n' | '\t')), "{text:?}");
    }

    #[test]
    fn refused_clients_do_not_fill_the_log_and_hide_nothing_of_ours() {
        let page = Page::default();
        let writer = page.clone();
        let filter = EnvFilter::new("debug");
        tracing::subscriber::with_default(
            subscriber(move || writer.clone(), filter, false),
            || {
                // All events of a learner come from one place in the code.
                for text in
                    std::iter::repeat_n("evaluator left", 1000).chain(["the score cannot be saved"])
                {
                    warn!(target: "zenoh_transport::unicast", "refused");
                    debug!(target: "zenoh_transport::unicast", "asked for");
                    info!("{text}");
                }
            },
        );
        let text = page.text();
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
