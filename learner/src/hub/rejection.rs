//! Why a message from the wire was not accepted.

use quad_protocol::CodecError;

use crate::scoreboard::Refusal;

/// Why a message from the wire was not accepted.
#[derive(Debug, thiserror::Error)]
pub(super) enum Rejection {
    #[error("the message is empty")]
    Empty,
    #[error("the message cannot be read: {0}")]
    Codec(#[from] CodecError),
    #[error("refused: {0}")]
    Refused(#[from] Refusal),
    #[error("there are too many evaluators")]
    Crowd,
    #[error("scores of the same episodes are being written, deliver these again")]
    InWriting,
    #[error("the scores could not be saved, try again: {0}")]
    NotSaved(String),
}

impl Rejection {
    pub fn label(&self) -> &'static str {
        match self {
            Self::Empty => "empty",
            Self::Codec(error) => error.label(),
            Self::Refused(refusal) => refusal.label(),
            Self::Crowd => "too_many_evaluators",
            Self::InWriting => "in_writing",
            Self::NotSaved(_) => "not_saved",
        }
    }
}
