//! Why nothing was recorded.

use quad_dataset::DatasetError;
use thiserror::Error;

use crate::sim::EnvironmentError;

/// Why nothing was recorded.
#[derive(Debug, Error)]
pub enum CollectError {
    /// The file could not be written.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// Nothing is recorded in that environment.
    #[error("nothing can be recorded in {environment}: {reason}")]
    NoRecipe {
        /// The environment.
        environment: &'static str,
        /// Why not.
        reason: &'static str,
    },
    /// The environment could not be made.
    #[error(transparent)]
    Environment(#[from] EnvironmentError),
}

impl CollectError {
    /// What to do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::NoRecipe { .. } => "`learner datasets list` names files of other environments",
            Self::Dataset(_) => "--out names a file in a folder that you may write in",
            Self::Environment(_) => "deploy/setup.sh installs the version of MuJoCo that this program was built for",
        }
    }
}
