//! Why the learner did not accept a message.

use quad_protocol::CodecError;

use crate::evaluation::Refusal;

/// Why the learner did not accept a message.
#[derive(Debug, thiserror::Error)]
pub(super) enum Rejection {
    #[error("the message is empty")]
    Empty,
    #[error("the message is too large")]
    Oversized,
    #[error("the message cannot be read: {0}")]
    Codec(#[from] CodecError),
    #[error("refused: {0}")]
    Refused(#[from] Refusal),
    #[error("there are too many evaluators")]
    Crowd,
    #[error("there is no snapshot of that step")]
    NoSnapshot,
    #[error("the snapshot cannot be read: {0:#}")]
    Unreadable(anyhow::Error),
    #[error("the scores could not be saved, try again: {0}")]
    NotSaved(String),
}

impl Rejection {
    /// The reason as a metric's label.
    pub fn label(&self) -> &'static str {
        match self {
            Self::Empty => "empty",
            Self::Oversized => "oversized",
            Self::Codec(error) => error.label(),
            Self::Refused(refusal) => refusal.label(),
            Self::Crowd => "too_many_evaluators",
            Self::NoSnapshot => "unknown_step",
            Self::Unreadable(_) => "unreadable_snapshot",
            Self::NotSaved(_) => "not_saved",
        }
    }
}
