//! Where training runs, as a name.

use serde::{Deserialize, Serialize};

/// Where training runs, as it is called on the command line and in files.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Device {
    /// The processor.
    #[default]
    Cpu,
    /// The first Nvidia GPU.
    Cuda,
}

impl Device {
    /// What it is called on command lines and in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
        }
    }
}
