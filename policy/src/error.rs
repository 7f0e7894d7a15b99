//! What can be wrong with weights.

/// Weights that are not what the architecture says.
#[derive(Debug, thiserror::Error)]
pub enum PolicyError {
    /// The bytes are no safetensors file.
    #[error("the weights are not a readable safetensors file")]
    Unreadable(#[from] safetensors::SafeTensorError),
    /// A tensor is missing.
    #[error("the weights lack the tensor {0:?}")]
    Missing(String),
    /// A tensor that no network has.
    #[error("the weights hold a tensor {0:?} that this architecture does not have")]
    Unexpected(String),
    /// A tensor of the wrong element type.
    #[error("tensor {name:?} holds {found}, expected F32")]
    Type {
        /// Its name.
        name: String,
        /// Its element type.
        found: String,
    },
    /// A tensor of the wrong shape.
    #[error("tensor {name:?} has shape {found:?}, expected {expected:?}")]
    Shape {
        /// Its name.
        name: String,
        /// Its shape.
        found: Vec<usize>,
        /// The architecture's.
        expected: Vec<usize>,
    },
    /// A NaN or an infinity.
    #[error("tensor {0:?} holds a number that is not finite")]
    NotFinite(String),
}
