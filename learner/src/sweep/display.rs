//! What a person sees of a sweep: a line for each run at work and one for all on a terminal, plain log lines otherwise.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use tracing::info;

/// How often the figures on a terminal change.
const REDRAW: Duration = Duration::from_secs(1);
/// How often a log gets them.
const LINES: Duration = Duration::from_secs(30);

/// The display.
pub(super) struct Display {
    /// `None` where stderr is no terminal.
    bar: Option<ProgressBar>,
    next: Instant,
}

impl Display {
    /// Starts it.
    pub fn start() -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
            // Without a style of ours the lines still come, with a little more beside them.
            if let Ok(style) = ProgressStyle::with_template("{msg}") {
                bar.set_style(style);
            }
            bar
        });
        let first = if bar.is_some() { REDRAW } else { LINES };
        Self { bar, next: Instant::now() + first }
    }

    /// An event, as a line of its own.
    pub fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.println(text),
            None => info!("{text}"),
        }
    }

    /// Whether it is time to show something new.
    pub fn is_due(&self, now: Instant) -> bool {
        now >= self.next
    }

    /// Shows these lines in place of the last ones.
    pub fn show(&mut self, lines: &[String]) {
        match &self.bar {
            Some(bar) => bar.set_message(lines.join("\n")),
            None => lines.iter().for_each(|line| info!("{line}")),
        }
        self.next = Instant::now() + if self.bar.is_some() { REDRAW } else { LINES };
    }

    /// Takes the lines away.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
