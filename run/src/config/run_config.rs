//! Contents of `config.toml` in a run's folder.

use std::path::PathBuf;

use quad_dataset::DatasetFile;
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

/// Statistics of the dataset, and its files. Without a dataset there are no files, and returns are
/// NaN.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "StoredInfo")]
pub struct DatasetInfo {
    /// Number of transitions that are trained on.
    pub transitions: u64,
    /// Number of trajectories that are trained on.
    pub episodes: u64,
    /// Indices of the episodes that are kept out of training, in the order of the files.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub held_out: Vec<usize>,
    /// Smallest return of a trajectory, unscaled.
    pub min_return: f64,
    /// Mean return of a trajectory, unscaled.
    pub mean_return: f64,
    /// Largest return of a trajectory, unscaled.
    pub max_return: f64,
    /// Mean D4RL-normalized score, where the environment has reference returns.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_score: Option<f64>,
    /// The files, in the order of their episodes.
    pub files: Vec<DatasetFile>,
}

/// Contents of `config.toml`, in which older runs have path and hash of one file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StoredInfo {
    path: Option<PathBuf>,
    sha256: Option<String>,
    transitions: u64,
    episodes: u64,
    #[serde(default)]
    held_out: Vec<usize>,
    min_return: f64,
    mean_return: f64,
    max_return: f64,
    mean_score: Option<f64>,
    #[serde(default)]
    files: Vec<DatasetFile>,
}

impl From<StoredInfo> for DatasetInfo {
    fn from(stored: StoredInfo) -> Self {
        let StoredInfo { path, sha256, transitions, episodes, mut files, .. } = stored;
        files.extend(path.map(|path| DatasetFile { path, sha256, transitions, episodes }));
        Self {
            transitions,
            episodes,
            held_out: stored.held_out,
            min_return: stored.min_return,
            mean_return: stored.mean_return,
            max_return: stored.max_return,
            mean_score: stored.mean_score,
            files,
        }
    }
}

impl DatasetInfo {
    /// SHA-256 of each file, separated by commas; `None` for older runs, which lack it.
    pub fn sha256(&self) -> Option<String> {
        let hashes: Option<Vec<&str>> =
            self.files.iter().map(|file| file.sha256.as_deref()).collect();
        Some(hashes?.join(", "))
    }

    /// Paths of the files.
    pub fn paths(&self) -> Vec<PathBuf> {
        self.files.iter().map(|file| file.path.clone()).collect()
    }

    /// Size and quality of the data, in one line.
    pub fn summary(&self) -> String {
        if self.files.is_empty() {
            return "no dataset".to_owned();
        }
        let (transitions, mean) = (self.transitions, self.mean_return);
        let episodes = counted(self.episodes as usize, "episode");
        let files = match self.files.len() {
            1 => String::new(),
            count => format!(" in {count} files"),
        };
        let mut text =
            format!("{transitions} transitions of {episodes}{files}, mean return {mean:.2}");
        if let Some(score) = self.mean_score {
            text += &format!(", mean score {score:.2}");
        }
        if !self.held_out.is_empty() {
            text += &format!("; held out: {}", counted(self.held_out.len(), "episode"));
        }
        text
    }
}
