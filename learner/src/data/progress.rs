//! What a person sees while a file is fetched: a bar on a terminal, plain log lines otherwise.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{HumanBytes, ProgressBar, ProgressDrawTarget, ProgressStyle};
use tracing::info;

/// How often a log gets a line.
const LINE: Duration = Duration::from_secs(5);
const BAR: &str = "{bar:40} {bytes}/{total_bytes} at {bytes_per_sec}, {eta} left";

/// The display of one file.
pub struct Progress {
    /// Hidden where stderr is no terminal.
    bar: ProgressBar,
    last_line: Cell<Instant>,
}

impl Progress {
    /// A display that shows nothing yet.
    pub fn new() -> Self {
        let target =
            if std::io::stderr().is_terminal() { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        Self { bar: ProgressBar::with_draw_target(None, target), last_line: Cell::new(Instant::now()) }
    }

    /// A connection starts to send what is behind the first `position` of so many bytes.
    pub fn start(&self, position: u64, bytes: u64) {
        // Without a style of ours the bar still works, with less beside it.
        if let Ok(style) = ProgressStyle::with_template(BAR) {
            self.bar.set_style(style);
        }
        self.bar.set_length(bytes);
        self.bar.set_position(position);
        self.bar.reset_eta();
    }

    /// So many bytes are there now.
    pub fn advance(&self, position: u64) {
        self.bar.set_position(position);
        if self.bar.is_hidden() && self.last_line.get().elapsed() >= LINE {
            self.last_line.set(Instant::now());
            let (bytes, rate) = (self.bar.length().unwrap_or(position), self.bar.per_sec() as u64);
            info!("{} of {} at {}/s", HumanBytes(position), HumanBytes(bytes), HumanBytes(rate));
        }
    }

    /// An event, as a line of its own.
    pub fn say(&self, text: &str) {
        self.bar.suspend(|| info!("{text}"));
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
