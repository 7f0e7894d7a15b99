//! Minari datasets: a folder with `main_data.hdf5`, one group per episode, and `metadata.json`.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::Value;

use crate::error::{DatasetError, Problem};
use crate::formats::array::Array;
use crate::formats::hdf5_file::Hdf5File;
use crate::recording::{Recording, RowKind};
use crate::tables::environment;

pub(super) const DATA_FILE: &str = "main_data.hdf5";

const EPISODE: &str = "episode_";

/// Folder of a Minari dataset such as `mujoco/hopper/medium-v0`, in `$MINARI_DATASETS_PATH` or
/// `~/.minari/datasets`.
pub fn minari_folder(id: &str) -> PathBuf {
    let root = match std::env::var_os("MINARI_DATASETS_PATH") {
        Some(root) if !root.is_empty() => PathBuf::from(root),
        _ => {
            let home = std::env::home_dir().unwrap_or_default();
            home.join(".minari/datasets")
        }
    };
    root.join(id).join("data")
}

pub(super) fn data_file(folder: &Path) -> Option<PathBuf> {
    let paths = [folder.join(DATA_FILE), folder.join("data").join(DATA_FILE)];
    paths.into_iter().find(|path| path.exists())
}

#[derive(Default, Deserialize)]
pub(crate) struct Metadata {
    /// JSON encoded as a string.
    env_spec: Option<String>,
    total_episodes: Option<usize>,
}

impl Metadata {
    pub(super) fn read(data_file: &Path) -> Result<Self, DatasetError> {
        let path = data_file.with_file_name("metadata.json");
        match fs::read(&path) {
            Ok(text) => serde_json::from_slice(&text)
                .map_err(|error| DatasetError::new(path, Problem::Metadata(error))),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(DatasetError::new(path, Problem::Io(error))),
        }
    }

    /// Name in the table of environments if its simulation is known, else Gymnasium's id.
    pub(super) fn environment(&self) -> Option<String> {
        let json: Value = serde_json::from_str(self.env_spec.as_ref()?).ok()?;
        let id = json["id"].as_str()?;
        let spec = environment::find_gymnasium(id);
        Some(spec.map_or(id, |spec| spec.name.as_str()).to_owned())
    }
}

/// Reads all episodes. The mask is 0 where `terminations` is 1. Dict and Tuple observations are
/// concatenated in the order of [`parts`].
pub(super) fn read(file: &Hdf5File, metadata: &Metadata) -> Result<Recording, Problem> {
    let mut recording = Recording { terminal_array: "terminations", ..Recording::default() };
    let names = file.members("/").unwrap_or_default();
    let number = |name: &String| name.strip_prefix(EPISODE)?.parse::<usize>().ok();
    let episodes = names.iter().filter_map(number).count();
    let expected = metadata.total_episodes.unwrap_or(episodes);
    if expected != episodes {
        return Err(Problem::Episodes(episodes, expected));
    }
    for episode in 0..episodes {
        append(file, &format!("{EPISODE}{episode}"), &mut recording)?;
    }
    Ok(recording)
}

/// Appends an episode of T steps as T + 1 rows, the last of which is its final state.
fn append(file: &Hdf5File, episode: &str, recording: &mut Recording) -> Result<(), Problem> {
    let array = |name: &str| format!("{episode}/{name}");
    let actions = file.actions(&array("actions"))?;
    let steps = actions.rows();
    let observations = observations(file, &array("observations"), steps + 1)?;
    if recording.parts.is_empty() {
        (recording.observation_dim, recording.action_dim) = (observations.width, actions.width);
    }
    let (o, a) = (recording.observation_dim, recording.action_dim);
    recording.parts.push((recording.rows(), episode.to_owned()));
    let states = observations.sized(steps + 1, o)?;
    let rewards: Vec<f32> = file.table(&array("rewards"), steps, 1)?;
    let terminals = file.flags(&array("terminations"), steps)?;
    let timeouts = file.flags(&array("truncations"), steps)?;
    recording.observations.extend(states);
    recording.actions.extend(actions.sized(steps, a)?);
    recording.rewards.extend(rewards);
    recording.terminals.extend(terminals);
    recording.timeouts.extend(timeouts);
    recording.ends.extend((1..=steps).map(|step| step == steps));
    let kinds = vec![RowKind::Transition; steps];
    recording.kinds.extend(kinds);
    recording.push_last_state();
    Ok(())
}

fn observations(file: &Hdf5File, name: &str, rows: usize) -> Result<Array<f32>, Problem> {
    let Some(members) = file.members(name) else { return file.numbers(name) };
    let read = |part: String| file.numbers(&format!("{name}/{part}"))?.with_rows(rows);
    let columns = parts(members).into_iter().map(read);
    let columns: Vec<Array<f32>> = columns.collect::<Result<_, _>>()?;
    let row = |row: usize| columns.iter().flat_map(move |column| column.row(row));
    let values = (0..rows).flat_map(row).copied().collect();
    let width = columns.iter().map(|column| column.width).sum();
    Array::new(name, vec![rows, width], values)
}

/// Order of concatenation: a Dict's arrays by name, a Tuple's by number (`_index_0`, …).
fn parts(mut names: Vec<String>) -> Vec<String> {
    let number = |name: &String| name.strip_prefix("_index_")?.parse::<usize>().ok();
    names.sort_by_key(number); // Names without a number keep their order.
    names
}
