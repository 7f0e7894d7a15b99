//! Errors of networks.

/// Weights that do not fit a network.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// A tensor is missing.
    #[error("the weights lack the tensor {0:?}")]
    Missing(String),
    /// A tensor has the wrong type or shape.
    #[error("tensor {name:?} has type and shape {found}, expected {expected}")]
    Shape {
        /// Name of the tensor.
        name: String,
        /// Its type and shape.
        found: String,
        /// The network's type and shape.
        expected: String,
    },
    /// A weight is NaN or infinite.
    #[error("tensor {0:?} holds a number that is not finite")]
    NotFinite(String),
    /// Candle cannot compute or move a tensor.
    #[error("candle failed")]
    Candle(#[from] candle_core::Error),
}

/// Largest width of a layer, and largest ensemble, that a file may ask for.
pub const MAX_DIM: usize = u16::MAX as usize;
