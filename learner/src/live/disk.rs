//! Reports of a disk that refuses writes: `/healthz` and a metric say so while it does; display and
//! log repeat it from time to time.

use std::time::{Duration, Instant};

use prometheus::IntGauge;
use quad_runtime::Heartbeat;
use tracing::warn;

use super::events::Events;

/// Interval of reminders in the log.
const REMIND: Duration = Duration::from_secs(60);

/// A thread that writes to the run's folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Writer {
    pub thread: &'static str,
    /// Its output, as a metric's label and for people.
    pub label: &'static str,
    output: &'static str,
    /// Consequence of a disk that hangs, for people.
    pub waits: &'static str,
}

impl Writer {
    /// Writes snapshots, checkpoints and metrics.
    pub const SNAPSHOTS: Self = Self {
        thread: "snapshots",
        label: "run",
        output: "the run",
        waits: "snapshots and checkpoints wait for it; training continues",
    };
    pub const SCORES: Self = Self {
        thread: "scores",
        label: "scores",
        output: "results",
        waits: "results wait for it; evaluators keep theirs",
    };
    pub const ALL: [Self; 2] = [Self::SNAPSHOTS, Self::SCORES];
}

/// The success of one thread's writes.
#[derive(Debug)]
pub(crate) struct DiskStatus {
    output: &'static str,
    gauge: IntGauge,
    events: Events,
    /// Start of the trouble, and time of the last reminder.
    trouble: Option<(Instant, Instant)>,
}

impl DiskStatus {
    pub fn new(writer: Writer, gauge: IntGauge, events: Events) -> Self {
        Self { output: writer.output, gauge, events, trouble: None }
    }

    /// Records that the disk refused a write.
    pub fn refused(&mut self, beat: &Heartbeat, error: &str) {
        let problem = format!("{} cannot be saved: {error}", self.output);
        beat.set_problem(Some(problem.clone()));
        self.gauge.set(1);
        let now = Instant::now();
        let (since, logged) = self.trouble.get_or_insert_with(|| {
            self.events.line(format!("{problem}; it is tried again until the disk takes it"));
            (now, now)
        });
        if now - *logged >= REMIND {
            *logged = now;
            warn!("for {} s {problem}", (now - *since).as_secs());
        }
    }

    /// Records that the disk accepted a write.
    pub fn accepted(&mut self, beat: &Heartbeat) {
        beat.set_problem(None);
        // The main loop sets the gauge, too, while this thread hangs.
        self.gauge.set(0);
        if self.trouble.take().is_some() {
            self.events.line(format!("{} can be saved again", self.output));
        }
    }
}
