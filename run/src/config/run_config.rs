//! Contents of `config.toml` in a run's folder.

use std::path::PathBuf;

use quad_protocol::Name;
use serde::{Deserialize, Serialize};

use super::experiment::Experiment;
use crate::counted;

/// Device on which a run trains; evaluators use the CPU.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Device {
    /// The CPU.
    #[default]
    Cpu,
    /// The first Nvidia GPU.
    Cuda,
}

impl Device {
    /// Name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
        }
    }
}

/// Contents of `config.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(missing_docs)] // The types say what each is.
pub struct RunConfig {
    pub run: RunInfo,
    pub dataset: DatasetInfo,
    pub experiment: Experiment,
}

/// Name, task, program and machine of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunInfo {
    /// Name of the run: its folder's name, and part of its Zenoh keys.
    pub name: Name,
    /// Time of the first start, in milliseconds since 1970. The file calls it `incarnation`; on the
    /// wire, this is the name of another number.
    #[serde(rename = "incarnation")]
    pub started: u64,
    /// The task, or the name of a user's file that names no task. Older runs call it their preset.
    #[serde(alias = "preset")]
    pub task: String,
    /// Version of the learner.
    pub version: String,
    /// CPU, number of threads and instructions of the machine on which the run began; absent in older
    /// runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machine: Option<String>,
    /// Device of training; absent in older runs.
    #[serde(default)]
    pub device: Device,
}

/// File, checksum and statistics of the dataset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetInfo {
    /// Path of the file or folder.
    pub path: PathBuf,
    /// SHA-256 of the file in hexadecimal, of a folder of Minari's that of its `main_data.hdf5`;
    /// absent in older runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
    /// Number of transitions that are trained on.
    pub transitions: u64,
    /// Number of trajectories that are trained on.
    pub episodes: u64,
    /// Indices of the episodes that are kept out of training, in the file's order.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub held_out: Vec<usize>,
    /// Smallest return of a trajectory, unscaled.
    pub min_return: f64,
    /// Mean return of a trajectory, unscaled.
    pub mean_return: f64,
    /// Largest return of a trajectory, unscaled.
    pub max_return: f64,
    /// Mean D4RL-normalized score, where the environment has reference returns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean_score: Option<f64>,
}

impl DatasetInfo {
    /// Size and quality of the data, in one line.
    pub fn summary(&self) -> String {
        let (transitions, mean) = (self.transitions, self.mean_return);
        let episodes = counted(self.episodes as usize, "episode");
        let mut text = format!("{transitions} transitions of {episodes}, mean return {mean:.2}");
        if let Some(score) = self.mean_score {
            text += &format!(", mean score {score:.2}");
        }
        if !self.held_out.is_empty() {
            text += &format!("; held out: {}", counted(self.held_out.len(), "episode"));
        }
        text
    }
}
