//! What a person sees of a sweep: a line for each run at work and one for all on a terminal, plain
//! log lines otherwise.

use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use quad_runtime::clean;
use tracing::info;

/// How often the figures on a terminal change.
const REDRAW: Duration = Duration::from_secs(1);
/// How often a log gets them.
const LINES: Duration = Duration::from_secs(30);

/// The display.
pub(super) struct Display {
    /// Hidden where stderr is no terminal.
    bar: ProgressBar,
    next: Instant,
}

impl Display {
    /// Starts it.
    pub fn start() -> Self {
        let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        // Without a style of ours the lines still come, with a little more beside them.
        if let Ok(style) = ProgressStyle::with_template("{msg}") {
            bar.set_style(style);
        }
        let mut display = Self { bar, next: Instant::now() };
        display.next += display.interval();
        display
    }

    fn interval(&self) -> Duration {
        if self.bar.is_hidden() { LINES } else { REDRAW }
    }

    /// An event, as a line of its own.
    pub fn say(&self, text: &str) {
        if self.bar.is_hidden() { info!("{text}") } else { self.bar.println(clean(text)) }
    }

    /// Whether it is time to show something new; then the next time is an interval later.
    pub fn is_due(&mut self) -> bool {
        let is_due = Instant::now() >= self.next;
        if is_due {
            self.next = Instant::now() + self.interval();
        }
        is_due
    }

    /// Shows these lines in place of the last ones.
    pub fn show(&self, lines: &[String]) {
        if self.bar.is_hidden() {
            lines.iter().for_each(|line| info!("{line}"));
        } else {
            self.bar.set_message(lines.join("\n"));
        }
    }

    /// Takes the lines away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
