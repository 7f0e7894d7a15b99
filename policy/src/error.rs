//! Errors of policies.

use quad_nn::{MAX_DIM, NetworkError};

pub(crate) type Result<T, E = PolicyError> = std::result::Result<T, E>;

/// The version that writes policies.
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");

/// A file that is no policy, or a policy that cannot act.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each variant is.
pub enum PolicyError {
    #[error("the weights are not a readable safetensors file")]
    Unreadable(#[from] safetensors::SafeTensorError),
    #[error("the file's metadata lacks `{0}`")]
    NoHeader(&'static str),
    #[error("the file's header is not understood: {0}")]
    Header(#[from] serde_json::Error),
    #[error(
        "the weights were written by version {version}, and this version, {VERSION}, does not understand them: {source}"
    )]
    Version { version: String, source: serde_json::Error },
    #[error("{field} is {value}, which is out of range")]
    Range { field: &'static str, value: usize },
    #[error(
        "the scaling of {what} in the file is not {columns} finite offsets and as many finite scales, none below 0"
    )]
    Scaling { what: &'static str, columns: usize },
    #[error("the softmax's temperature is {0}, but must be above 0 and finite")]
    Temperature(f32),
    #[error("the strength of guidance is {0}, but must be at least 0 and finite")]
    Guidance(f32),
    #[error("guidance takes a diffusion policy with critics, which this is not")]
    NoGuidance,
    #[error("this policy draws no candidates, so there is nothing to choose among")]
    NoCandidates,
    #[error("this policy has no critics, which would value its actions")]
    NoCritics,
    #[error(
        "the values of this policy are of a history of {history} and a chunk of {length}, not of one observation and one action"
    )]
    ValuesChunks { history: usize, length: usize },
    #[error("the rule `nearest` takes a value function, which this policy does not have")]
    NoValue,
    #[error(transparent)]
    Network(#[from] NetworkError),
    #[error("the weights hold a tensor {0:?} that this policy does not have")]
    Unexpected(String),
    #[error("{0} is not a number (NaN)")]
    NotANumber(&'static str),
    #[error("candle failed")]
    Candle(#[from] candle_core::Error),
}

impl PolicyError {
    /// Tells the user how to fix it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::Network(error) => error.hint(),
            Self::Version { .. } => "read it with that version, or train again",
            Self::NotANumber(_) => "its training has diverged: take an earlier snapshot",
            Self::NoCandidates | Self::NoCritics | Self::NoValue | Self::NoGuidance => {
                "score it without --candidates, --rule, --aggregate and --guidance"
            }
            Self::ValuesChunks { .. } => {
                "the samples of a policy come with the values of their chunks"
            }
            Self::Temperature(_) | Self::Guidance(_) => {
                "give another number; a file with such a number is damaged"
            }
            Self::Range { .. } => {
                "give a smaller number above 0; a file with such a number is damaged"
            }
            _ => {
                "pass a file like RUN/snapshots/step_000020000.safetensors, written by `learner train` of this version"
            }
        }
    }
}

/// Checks that a number of the header is from 1 to `most`.
pub(crate) fn check_range(field: &'static str, value: usize, most: usize) -> Result<()> {
    match (1..=most).contains(&value) {
        true => Ok(()),
        false => Err(PolicyError::Range { field, value }),
    }
}

/// Checks the lengths of an observation and of an action.
pub(crate) fn check_dims(observation_dim: usize, action_dim: usize) -> Result<()> {
    check_range("observation_dim", observation_dim, MAX_DIM)?;
    check_range("action_dim", action_dim, MAX_DIM)
}

/// Checks that no number is NaN.
pub(crate) fn check_numbers(what: &'static str, numbers: &[f32]) -> Result<()> {
    match numbers.iter().any(|x| x.is_nan()) {
        true => Err(PolicyError::NotANumber(what)),
        false => Ok(()),
    }
}
