//! Reports of the other threads to the main loop.

use quad_protocol::EpisodeScore;
use tokio::sync::mpsc::UnboundedSender;

use crate::train::Outcome;

/// A report of another thread to the main loop.
#[derive(Debug)]
pub(crate) enum Event {
    /// A line for the user. Lines that the network can cause are sent once for each step, name or
    /// period, so the queue stays short.
    Line(String),
    /// A snapshot is ready to be evaluated.
    Published { step: u64 },
    /// All episodes of an evaluation are scored.
    Evaluated { step: u64, scores: Vec<EpisodeScore> },
    /// No gradient step will follow, and all output of training is on the disk.
    TrainingEnded(Outcome),
    /// The run cannot continue.
    Failed(anyhow::Error),
}

/// Sends events, which get lost once the main loop has ended.
#[derive(Clone, Debug)]
pub(crate) struct Events(pub UnboundedSender<Event>);

impl Events {
    pub fn send(&self, event: Event) {
        self.0.send(event).ok();
    }

    pub fn line(&self, text: impl Into<String>) {
        self.send(Event::Line(text.into()));
    }
}
