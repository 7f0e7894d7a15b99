//! Progress of a task of known size: a bar on a terminal, else log lines.

use std::cell::Cell;
use std::time::{Duration, Instant};

use indicatif::{HumanBytes, ProgressDrawTarget, ProgressStyle};
use tracing::info;

use crate::exit::clean;

/// Interval of log lines.
const LINE: Duration = Duration::from_secs(5);

/// Progress of a task, such as a download.
pub struct ProgressBar {
    /// Hidden if stderr is no terminal.
    bar: indicatif::ProgressBar,
    /// The unit; `None` for bytes.
    unit: Option<&'static str>,
    last_line: Cell<Instant>,
}

impl ProgressBar {
    /// Progress in bytes, not shown yet.
    pub fn bytes() -> Self {
        let bar = indicatif::ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        Self { bar, unit: None, last_line: Cell::new(Instant::now()) }
    }

    /// Progress in another unit, such as `transitions recorded`, not shown yet.
    pub fn new(unit: &'static str) -> Self {
        let mut progress = Self::bytes();
        progress.unit = Some(unit);
        progress
    }

    /// Starts, or starts again, with `position` of `length` done.
    pub fn start(&self, position: u64, length: u64) {
        let figures = match self.unit {
            None => "{bytes}/{total_bytes} at {bytes_per_sec}".to_owned(),
            Some(unit) => format!("{{pos}}/{{len}} {unit}"),
        };
        // Without our style the bar still works, but shows less.
        let template = format!("{{bar:40}} {figures}, {{eta}} left");
        if let Ok(style) = ProgressStyle::with_template(&template) {
            self.bar.set_style(style);
        }
        self.bar.set_length(length);
        self.bar.set_position(position);
        self.bar.reset_eta();
    }

    /// Updates the position.
    pub fn advance(&self, position: u64) {
        self.bar.set_position(position);
        if !self.bar.is_hidden() || self.last_line.get().elapsed() < LINE {
            return;
        }
        self.last_line.set(Instant::now());
        let length = self.bar.length().unwrap_or(position);
        match self.unit {
            Some(unit) => info!("{position} of {length} {unit}"),
            None => {
                let rate = HumanBytes(self.bar.per_sec() as u64);
                info!("{} of {} at {rate}/s", HumanBytes(position), HumanBytes(length));
            }
        }
    }

    /// Shows a message above the bar.
    pub fn say(&self, text: &str) {
        if self.bar.is_hidden() { info!("{text}") } else { self.bar.println(clean(text)) }
    }
}

impl Drop for ProgressBar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
