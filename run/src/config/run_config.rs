//! What a run's folder says of itself in `config.toml`.

use std::path::PathBuf;

use quad_protocol::Name;
use serde::{Deserialize, Serialize};

use super::device::Device;
use super::experiment::Experiment;

/// The file's contents.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Which run this is.
    pub run: RunInfo,
    /// What it learns from.
    pub dataset: DatasetInfo,
    /// How it learns.
    pub experiment: Experiment,
}

/// Which run this is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunInfo {
    /// Name of the run: its folder's name, and its place in Zenoh's key space.
    pub name: Name,
    /// When the run was first started, in milliseconds since 1970. In the file it is called
    /// `incarnation`, as it always was; it is not the number of a learner's start on the wire,
    /// which has that name, too.
    #[serde(rename = "incarnation")]
    pub started: u64,
    /// Task that was asked for; of a user's file that names none, the file's name. Older runs call
    /// it their preset.
    #[serde(alias = "preset")]
    pub task: String,
    /// Version of the learner.
    pub version: String,
    /// The machine on which the run began: its CPU, how many threads of it, and the instructions it
    /// multiplies with. Older runs do not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub machine: Option<String>,
    /// Where it trains; runs from before there was a choice do not say.
    #[serde(default)]
    pub device: Device,
}

/// What the run learns from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetInfo {
    /// The file.
    pub path: PathBuf,
    /// SHA-256 of the file in hexadecimal, of a folder of Minari's that of its `main_data.hdf5`;
    /// older runs do not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
    /// Transitions that are learned from.
    pub transitions: u64,
    /// Trajectories in the file.
    pub episodes: u64,
    /// Numbers of the episodes that are kept out of training, from 0 in the file's order; the other
    /// figures are not of them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub held_out: Vec<usize>,
    /// Smallest return of a trajectory, unscaled.
    pub min_return: f64,
    /// The mean of their returns.
    pub mean_return: f64,
    /// The largest of them.
    pub max_return: f64,
    /// Mean D4RL-normalized score of the trajectories, where the environment has reference returns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean_score: Option<f64>,
}

impl DatasetInfo {
    /// How much it holds and how good it is, in one line.
    pub fn summary(&self) -> String {
        let Self { transitions, episodes, held_out, mean_return, mean_score, .. } = self;
        let score = mean_score.map(|score| format!(", mean score {score:.2}")).unwrap_or_default();
        let held_out = if held_out.is_empty() {
            String::new()
        } else {
            format!("; {} more are held out", held_out.len())
        };
        format!(
            "{transitions} transitions of {episodes} episodes, mean return {mean_return:.2}{score}{held_out}"
        )
    }
}
