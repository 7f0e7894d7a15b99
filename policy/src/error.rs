//! What can be wrong with a policy.

use quad_nn::NetworkError;

/// The version that writes policies.
pub(crate) const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Weights that are not what they should be, or that lead to no action.
#[derive(Debug, thiserror::Error)]
pub enum PolicyError {
    /// The bytes are no safetensors file.
    #[error("the weights are not a readable safetensors file")]
    Unreadable(#[from] safetensors::SafeTensorError),
    /// The file does not say what it holds.
    #[error("the file does not say what it holds (metadata `{0}`)")]
    NoHeader(&'static str),
    /// What it says is not understood.
    #[error("what the weights say about themselves is not understood: {0}")]
    Header(#[from] serde_json::Error),
    /// What it says is not understood, and another version wrote it.
    #[error(
        "the weights were written by version {version}, and this version, {VERSION}, does not understand them: {source}"
    )]
    Version {
        /// The version that wrote them, and reads them.
        version: String,
        /// What is not understood.
        source: serde_json::Error,
    },
    /// A shape with a number out of range.
    #[error("the weights' {field} is {value}, which is out of range")]
    Range {
        /// Name in the header.
        field: &'static str,
        /// What it says.
        value: usize,
    },
    /// A map to the user's units that does not fit the policy.
    #[error(
        "the scaling of {what} in the file is not {columns} finite offsets and as many finite scales, none below 0"
    )]
    Scaling {
        /// Observations or actions.
        what: &'static str,
        /// Their numbers.
        columns: usize,
    },
    /// A temperature that nothing can be drawn with.
    #[error("the softmax's temperature is {0}, but must be above 0")]
    Temperature(f32),
    /// It is to choose among candidates, but draws none.
    #[error("this policy draws no candidates, so there is nothing to choose among")]
    NoCandidates,
    /// It is to say what actions are worth, but has no critics.
    #[error("this policy has no critics, which would say what a single action is worth")]
    NoCritics,
    /// It is to choose by a value function, but has none.
    #[error("the rule `nearest` takes a value function, which this policy does not have")]
    NoValue,
    /// The weights do not fit, or a network fails.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// A tensor that no network has.
    #[error("the weights hold a tensor {0:?} that this policy does not have")]
    Unexpected(String),
    /// A NaN on the way to an action.
    #[error("{0} is not a number (NaN)")]
    NotANumber(&'static str),
    /// Candle cannot compute or move a tensor.
    #[error("candle failed")]
    Candle(#[from] candle_core::Error),
}

/// Checks that a number of a shape is from 1 to `most`.
pub(crate) fn check_range(
    field: &'static str,
    value: usize,
    most: usize,
) -> Result<(), PolicyError> {
    if (1..=most).contains(&value) { Ok(()) } else { Err(PolicyError::Range { field, value }) }
}

/// Checks that none of these is a NaN.
pub(crate) fn check_numbers(what: &'static str, numbers: &[f32]) -> Result<(), PolicyError> {
    if numbers.iter().any(|x| x.is_nan()) { Err(PolicyError::NotANumber(what)) } else { Ok(()) }
}
