//! How the disk takes what a thread writes: `/healthz` and a metric say so for as long as it refuses, display and log now and
//! then.

use std::time::{Duration, Instant};

use prometheus::IntGauge;
use quad_service::Beat;
use tracing::warn;

use super::events::{Event, Events, Saved};
use super::metrics::DiskMetrics;

/// A disk that stays in trouble is spoken of this often.
const REMIND: Duration = Duration::from_secs(60);

/// How the disk takes what one thread writes.
#[derive(Debug)]
pub(crate) struct DiskStatus {
    what: Saved,
    gauge: IntGauge,
    events: Events,
    /// Since when it does not, and when that was last said.
    trouble: Option<(Instant, Instant)>,
}

impl DiskStatus {
    /// No trouble yet.
    pub fn new(what: Saved, metrics: &DiskMetrics, events: Events) -> Self {
        Self { what, gauge: metrics.trouble(what), events, trouble: None }
    }

    /// The disk has refused something.
    pub fn refused(&mut self, beat: &Beat, error: &str) {
        let (now, what) = (Instant::now(), self.what);
        beat.set_trouble(Some(format!("{} cannot be saved: {error}", what.name())));
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

    /// The disk has taken something.
    pub fn well(&mut self, beat: &Beat) {
        beat.set_trouble(None);
        // The main loop sets it, too, while this thread hangs.
        self.gauge.set(0);
        if self.trouble.take().is_some() {
            self.events.send(Event::DiskWell(self.what)).ok();
        }
    }
}
