//! Shows the progress of a task of known size: a bar on a terminal, plain log lines otherwise.

use std::cell::Cell;
use std::time::{Duration, Instant};

use indicatif::{HumanBytes, ProgressDrawTarget, ProgressStyle};
use tracing::info;

use crate::exit::clean;

/// How often a log gets a line.
const LINE: Duration = Duration::from_secs(5);

/// Shows the progress of one task, such as a fetch of a file.
pub struct ProgressBar {
    /// Hidden if stderr is no terminal.
    bar: indicatif::ProgressBar,
    /// What is counted; `None` for bytes.
    counted: Option<&'static str>,
    last_line: Cell<Instant>,
}

impl ProgressBar {
    /// A display of bytes that shows nothing yet.
    pub fn of_bytes() -> Self {
        Self::new(None)
    }

    /// A display that shows nothing yet, of `counted` things, such as `transitions recorded`.
    pub fn of(counted: &'static str) -> Self {
        Self::new(Some(counted))
    }

    fn new(counted: Option<&'static str>) -> Self {
        let bar = indicatif::ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        Self { bar, counted, last_line: Cell::new(Instant::now()) }
    }

    /// Starts (again) with `position` of `length` done.
    pub fn start(&self, position: u64, length: u64) {
        let figures =
            self.counted.map_or("{bytes}/{total_bytes} at {bytes_per_sec}".to_owned(), |counted| {
                format!("{{pos}}/{{len}} {counted}")
            });
        // Without our style the bar still works, but shows less.
        if let Ok(style) =
            ProgressStyle::with_template(&format!("{{bar:40}} {figures}, {{eta}} left"))
        {
            self.bar.set_style(style);
        }
        self.bar.set_length(length);
        self.bar.set_position(position);
        self.bar.reset_eta();
    }

    /// Sets how much is done.
    pub fn advance(&self, position: u64) {
        self.bar.set_position(position);
        if !self.bar.is_hidden() || self.last_line.get().elapsed() < LINE {
            return;
        }
        self.last_line.set(Instant::now());
        let length = self.bar.length().unwrap_or(position);
        match self.counted {
            Some(counted) => info!("{position} of {length} {counted}"),
            None => {
                let rate = HumanBytes(self.bar.per_sec() as u64);
                info!("{} of {} at {rate}/s", HumanBytes(position), HumanBytes(length));
            }
        }
    }

    /// An event, as a line of its own.
    pub fn say(&self, text: &str) {
        if self.bar.is_hidden() { info!("{text}") } else { self.bar.println(clean(text)) }
    }
}

impl Drop for ProgressBar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
