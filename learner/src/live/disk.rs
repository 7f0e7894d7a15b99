//! Whether the disk accepts what a thread writes. While it does not, `/healthz` and a metric say
//! so; display and log repeat it from time to time.

use std::time::{Duration, Instant};

use prometheus::IntGauge;
use quad_runtime::Heartbeat;
use tracing::warn;

use super::events::{Event, Events, Saved};
use super::metrics::DiskMetrics;

/// How often the log repeats that the disk is in trouble.
const REMIND: Duration = Duration::from_secs(60);

/// Whether the disk accepts what one thread writes.
#[derive(Debug)]
pub(crate) struct DiskStatus {
    what: Saved,
    gauge: IntGauge,
    events: Events,
    /// When the trouble began, and when it was last logged.
    trouble: Option<(Instant, Instant)>,
}

impl DiskStatus {
    /// A status without trouble.
    pub fn new(what: Saved, metrics: &DiskMetrics, events: Events) -> Self {
        Self { what, gauge: metrics.trouble(what), events, trouble: None }
    }

    /// Records that the disk refused a write.
    pub fn refused(&mut self, beat: &Heartbeat, error: &str) {
        let (now, what) = (Instant::now(), self.what);
        beat.set_problem(Some(format!("{} cannot be saved: {error}", what.name())));
        self.gauge.set(1);
        let (since, said) = self.trouble.get_or_insert_with(|| {
            self.events.send(Event::DiskTrouble(what, error.to_owned())).ok();
            (now, now)
        });
        if now - *said >= REMIND {
            *said = now;
            warn!("for {} s {} cannot be saved: {error}", (now - *since).as_secs(), what.name());
        }
    }

    /// Records that the disk accepted a write.
    pub fn well(&mut self, beat: &Heartbeat) {
        beat.set_problem(None);
        // The main loop sets the gauge, too, while this thread hangs.
        self.gauge.set(0);
        if self.trouble.take().is_some() {
            self.events.send(Event::DiskWell(self.what)).ok();
        }
    }
}
