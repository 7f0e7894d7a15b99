//! Bounds how much is logged: whoever reaches a program over the network could fill its disk with log lines otherwise.

use std::collections::HashMap;
use std::fmt;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use tracing::callsite::Identifier;
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

/// Most lines from one place in the code within a period.
const LINES: u32 = 100;
const PERIOD: Duration = Duration::from_secs(60);

/// Formats lines as `F` does, and leaves out those that are too many of a kind; a line says that there are more. Lines for
/// debugging are only there on request, so all of them are written.
pub struct Throttled<F> {
    format: F,
    /// By their place in the code: when its period began, and the lines since then.
    counts: Mutex<HashMap<Identifier, (Instant, u32)>>,
}

impl<F> Throttled<F> {
    pub fn new(format: F) -> Self {
        Self { format, counts: Mutex::default() }
    }

    /// Which line of its kind this is, counted from 1 in each period.
    fn count(&self, kind: Identifier, now: Instant) -> u32 {
        let mut counts = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        let (since, count) = counts.entry(kind).or_insert((now, 0));
        if now - *since >= PERIOD {
            (*since, *count) = (now, 0);
        }
        *count = count.saturating_add(1);
        *count
    }
}

impl<S, N, F> FormatEvent<S, N> for Throttled<F>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
    F: FormatEvent<S, N>,
{
    fn format_event(&self, context: &FmtContext<'_, S, N>, mut writer: Writer<'_>, event: &Event<'_>) -> fmt::Result {
        let metadata = event.metadata();
        if *metadata.level() > Level::INFO {
            return self.format.format_event(context, writer, event);
        }
        let count = self.count(metadata.callsite(), Instant::now());
        if count <= LINES {
            self.format.format_event(context, writer.by_ref(), event)?;
        }
        if count == LINES {
            writeln!(writer, "(more lines like the last one are left out for up to {} s)", PERIOD.as_secs())?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::Arc;

    use tracing::{debug, info, warn};
    use tracing_subscriber::fmt::format;

    use super::*;

    #[derive(Clone, Default)]
    struct Page(Arc<Mutex<Vec<u8>>>);

    impl Write for Page {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_flood_of_one_kind_is_cut_off_and_nothing_else_is() {
        let page = Page::default();
        let writer = page.clone();
        let subscriber = tracing_subscriber::fmt()
            .with_max_level(Level::DEBUG)
            .event_format(Throttled::new(format()))
            .with_writer(move || writer.clone())
            .finish();
        tracing::subscriber::with_default(subscriber, || {
            for number in 0..1000 {
                info!(number, "flood");
                debug!(number, "asked for");
            }
            warn!("alone");
        });
        let text = String::from_utf8(page.0.lock().unwrap().clone()).unwrap();
        let count = |what: &str| text.lines().filter(|line| line.contains(what)).count();
        assert_eq!((count("flood"), count("asked for"), count("alone")), (LINES as usize, 1000, 1));
        assert_eq!((count("left out"), text.lines().count()), (1, LINES as usize + 1002));
    }

    #[test]
    fn each_period_begins_anew() {
        let throttled = Throttled::new(format());
        let mut kinds = Vec::new();
        let subscriber = tracing_subscriber::registry();
        tracing::subscriber::with_default(subscriber, || {
            kinds.push(tracing::info_span!("one").metadata().unwrap().callsite());
            kinds.push(tracing::info_span!("other").metadata().unwrap().callsite());
        });
        let start = Instant::now();
        let count = |kind: usize, seconds| throttled.count(kinds[kind].clone(), start + Duration::from_secs(seconds));
        assert_eq!([count(0, 0), count(0, 1), count(1, 1), count(0, 59)], [1, 2, 1, 3]);
        assert_eq!([count(0, 60), count(1, 60), count(1, 61)], [1, 2, 1]);
    }
}
