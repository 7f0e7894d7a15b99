//! Errors of policies.

use quad_nn::NetworkError;

/// The version that writes policies.
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");

/// A file that is no policy, or a policy that cannot act.
#[derive(Debug, thiserror::Error)]
pub enum PolicyError {
    /// The bytes are not a safetensors file.
    #[error("the weights are not a readable safetensors file")]
    Unreadable(#[from] safetensors::SafeTensorError),
    /// The file has no header.
    #[error("the file does not say what it holds (metadata `{0}`)")]
    NoHeader(&'static str),
    /// The header cannot be parsed.
    #[error("what the weights say about themselves is not understood: {0}")]
    Header(#[from] serde_json::Error),
    /// The header cannot be parsed, and another version wrote it.
    #[error(
        "the weights were written by version {version}, and this version, {VERSION}, does not understand them: {source}"
    )]
    Version {
        /// The version that wrote it.
        version: String,
        /// The error of the parser.
        source: serde_json::Error,
    },
    /// A number of the header is out of range.
    #[error("the weights' {field} is {value}, which is out of range")]
    Range {
        /// Name of the number.
        field: &'static str,
        /// The number.
        value: usize,
    },
    /// A scaling that does not fit the policy.
    #[error(
        "the scaling of {what} in the file is not {columns} finite offsets and as many finite scales, none below 0"
    )]
    Scaling {
        /// "observations" or "actions".
        what: &'static str,
        /// Their length.
        columns: usize,
    },
    /// A temperature that is not positive and finite.
    #[error("the softmax's temperature is {0}, but must be above 0")]
    Temperature(f32),
    /// A choice among candidates, which the policy does not draw.
    #[error("this policy draws no candidates, so there is nothing to choose among")]
    NoCandidates,
    /// A question to critics, which the policy does not have.
    #[error("this policy has no critics, which would value a single action")]
    NoCritics,
    /// A choice by a value function, which the policy does not have.
    #[error("the rule `nearest` takes a value function, which this policy does not have")]
    NoValue,
    /// The weights do not fit a network.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// A tensor that belongs to no network.
    #[error("the weights hold a tensor {0:?} that this policy does not have")]
    Unexpected(String),
    /// A NaN in an action or a value.
    #[error("{0} is not a number (NaN)")]
    NotANumber(&'static str),
    /// Candle cannot compute or move a tensor.
    #[error("candle failed")]
    Candle(#[from] candle_core::Error),
}

/// Checks that a number of the header is from 1 to `most`.
pub(crate) fn check_range(
    field: &'static str,
    value: usize,
    most: usize,
) -> Result<(), PolicyError> {
    if (1..=most).contains(&value) { Ok(()) } else { Err(PolicyError::Range { field, value }) }
}

/// Checks that no number is NaN.
pub(crate) fn check_numbers(what: &'static str, numbers: &[f32]) -> Result<(), PolicyError> {
    if numbers.iter().any(|x| x.is_nan()) { Err(PolicyError::NotANumber(what)) } else { Ok(()) }
}
