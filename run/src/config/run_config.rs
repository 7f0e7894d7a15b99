//! Contents of `config.toml` in a run's folder.

use std::path::PathBuf;

use quad_dataset::DatasetFile;
use quad_protocol::Name;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};
use toml::Table;

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
    #[serde(deserialize_with = "read_dataset")]
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
#[serde(deny_unknown_fields)]
pub struct DatasetInfo {
    /// Number of transitions that are trained on.
    pub transitions: u64,
    /// Number of trajectories that are trained on.
    pub episodes: u64,
    /// Indices of the episodes that are kept out of training, in the order of the files.
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
    /// The files, in the order of their episodes.
    pub files: Vec<DatasetFile>,
}

/// Reads what a run has learned from; an older run's path and hash are those of its one file.
fn read_dataset<'de, D: Deserializer<'de>>(source: D) -> Result<DatasetInfo, D::Error> {
    let mut info = Table::deserialize(source)?;
    let mut file: Table =
        ["path", "sha256"].iter().filter_map(|key| info.remove_entry(*key)).collect();
    if !file.is_empty() {
        let counts = ["transitions", "episodes"].iter();
        file.extend(counts.filter_map(|key| Some((key.to_string(), info.get(*key)?.clone()))));
        info.insert("files".to_owned(), vec![file].into());
    }
    info.try_into().map_err(D::Error::custom)
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
