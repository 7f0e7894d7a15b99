//! Errors of networks.

/// Weights that do not fit a network.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each variant is.
pub enum NetworkError {
    #[error("the weights lack the tensor {0:?}")]
    Missing(String),
    #[error("tensor {0:?} has type and shape {1}, expected {2}")]
    Shape(String, String, String),
    #[error("tensor {0:?} holds a number that is not finite")]
    NotFinite(String),
    #[error("candle failed")]
    Candle(#[from] candle_core::Error),
}

impl NetworkError {
    /// Tells the user how to fix it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::NotFinite(_) => "its training has diverged: take an earlier snapshot",
            Self::Candle(_) => "smaller networks and batches take less memory",
            _ => "read the file with the version that wrote it, or copy it again",
        }
    }
}

/// Largest width of a layer, and largest ensemble, that a file may ask for.
pub const MAX_DIM: usize = u16::MAX as usize;
