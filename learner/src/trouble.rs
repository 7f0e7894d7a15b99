//! A disk that does not take something: `/healthz` and a metric say so for as long as it lasts, the display and the log now
//! and then.

use std::time::{Duration, Instant};

use prometheus::IntGauge;
use quad_service::Beat;
use tokio::sync::mpsc::UnboundedSender;
use tracing::warn;

use crate::metrics::DiskMetrics;
use crate::notice::Notice;

/// A disk that stays in trouble is spoken of this often.
const REMIND: Duration = Duration::from_secs(60);

/// What a thread writes to the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Saved {
    /// Snapshots and checkpoints.
    Run,
    /// Scores.
    Scores,
}

impl Saved {
    /// The metric's label.
    pub fn label(self) -> &'static str {
        match self {
            Self::Run => "run",
            Self::Scores => "scores",
        }
    }

    /// For people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Run => "the run",
            Self::Scores => "scores",
        }
    }
}

/// How the disk takes what one thread writes.
#[derive(Debug)]
pub struct Trouble {
    what: Saved,
    gauge: IntGauge,
    notices: UnboundedSender<Notice>,
    /// Since when it does not, and when that was last said.
    lasts: Option<(Instant, Instant)>,
}

impl Trouble {
    /// None yet.
    pub fn new(what: Saved, metrics: &DiskMetrics, notices: UnboundedSender<Notice>) -> Self {
        Self { what, gauge: metrics.trouble(what), notices, lasts: None }
    }

    /// The disk has refused something.
    pub fn refused(&mut self, beat: &Beat, error: &str) {
        let (now, what) = (Instant::now(), self.what);
        beat.set_trouble(Some(format!("{} cannot be saved: {error}", what.name())));
        self.gauge.set(1);
        let (since, said) = self.lasts.get_or_insert_with(|| {
            self.notices.send(Notice::DiskTrouble(what, error.to_owned())).ok();
            (now, now)
        });
        if now - *said >= REMIND {
            *said = now;
            warn!("for {} s {} cannot be saved: {error}", (now - *since).as_secs(), what.name());
        }
    }

    /// The disk has taken something.
    pub fn over(&mut self, beat: &Beat) {
        beat.set_trouble(None);
        // Also set by whoever sees that this thread hangs.
        self.gauge.set(0);
        if self.lasts.take().is_some() {
            self.notices.send(Notice::DiskWell(self.what)).ok();
        }
    }
}
