//! What a person sees while something of known size is done: a bar on a terminal, plain log lines otherwise.

use std::cell::Cell;
use std::time::{Duration, Instant};

use indicatif::{HumanBytes, ProgressBar, ProgressDrawTarget, ProgressStyle};
use tracing::info;

/// How often a log gets a line.
const LINE: Duration = Duration::from_secs(5);

/// The display of one thing that is done, such as a file that is fetched.
pub struct Progress {
    /// Hidden where stderr is no terminal.
    bar: ProgressBar,
    /// What is counted; none of bytes.
    counted: Option<&'static str>,
    last_line: Cell<Instant>,
}

impl Progress {
    /// A display of bytes that shows nothing yet.
    pub fn of_bytes() -> Self {
        Self::new(None)
    }

    /// A display that shows nothing yet, of what is `counted`, such as `transitions recorded`.
    pub fn of(counted: &'static str) -> Self {
        Self::new(Some(counted))
    }

    fn new(counted: Option<&'static str>) -> Self {
        let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        Self { bar, counted, last_line: Cell::new(Instant::now()) }
    }

    /// Starts, or starts again, behind the first `position` of so many.
    pub fn start(&self, position: u64, length: u64) {
        let figures = self.counted.map_or("{bytes}/{total_bytes} at {bytes_per_sec}".to_owned(), |counted| {
            format!("{{pos}}/{{len}} {counted}")
        });
        // Without a style of ours the bar still works, with less beside it.
        if let Ok(style) = ProgressStyle::with_template(&format!("{{bar:40}} {figures}, {{eta}} left")) {
            self.bar.set_style(style);
        }
        self.bar.set_length(length);
        self.bar.set_position(position);
        self.bar.reset_eta();
    }

    /// So many are done.
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
        if self.bar.is_hidden() { info!("{text}") } else { self.bar.println(text) }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
