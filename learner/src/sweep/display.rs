//! The display of a sweep: a line for each running learner and a total on a terminal, log lines
//! otherwise.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use quad_runtime::clean;
use tracing::info;

pub(super) struct Display {
    /// Hidden where stderr is no terminal.
    bar: ProgressBar,
}

impl Display {
    pub fn new() -> Self {
        let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        // The default style shows the message, too.
        if let Ok(style) = ProgressStyle::with_template("{msg}") {
            bar.set_style(style);
        }
        Self { bar }
    }

    pub fn interval(&self) -> Duration {
        Duration::from_secs(if self.bar.is_hidden() { 30 } else { 1 })
    }

    pub fn print(&self, text: &str) {
        if self.bar.is_hidden() { info!("{text}") } else { self.bar.println(clean(text)) }
    }

    /// Replaces the lines on a terminal.
    pub fn show(&self, lines: &[String]) {
        if self.bar.is_hidden() {
            lines.iter().for_each(|line| info!("{line}"));
        } else {
            self.bar.set_message(lines.join("\n"));
        }
    }

    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}
