//! Files that are one dataset, one after the other.

use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::{DatasetError, Problem};
use crate::formats::Source;
use crate::recording::{ACTION_NAMES, Names, OBSERVATION_NAMES, Recording};
use crate::tables::environment::{EnvironmentSpec, simulation_name};
use crate::tables::maze::MazeTask;

/// A file of a dataset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetFile {
    /// Path of the file or folder.
    pub path: PathBuf,
    /// SHA-256 of the file in hexadecimal, of a folder of Minari's that of its `main_data.hdf5`;
    /// `None` if it was not computed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
    /// Number of its transitions.
    pub transitions: u64,
    /// Number of its episodes.
    pub episodes: u64,
}

/// Size and hash.
impl fmt::Display for DatasetFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ending = if self.episodes == 1 { "" } else { "s" };
        write!(f, "{} transitions of {} episode{ending}", self.transitions, self.episodes)?;
        let mut sha256 = self.sha256.iter();
        sha256.try_for_each(|sha256| write!(f, ", SHA-256 {sha256}"))
    }
}

/// Reads files as one recording. Each is read and passed to `check` as if it were alone, and its end
/// ends its last episode. Refuses files that differ in their [`traits`], and those of another
/// environment than that asked for.
pub(crate) fn read(
    paths: &[impl AsRef<Path>],
    asked: Option<&EnvironmentSpec>,
    environment: Option<&EnvironmentSpec>,
    task: Option<MazeTask>,
    mut check: impl FnMut(&Path, &Source, &Recording) -> Result<(), Problem>,
) -> Result<(Recording, Vec<DatasetFile>), DatasetError> {
    let (mut joined, mut files, mut first) =
        (Recording::default(), Vec::<DatasetFile>::new(), None);
    for path in paths.iter().map(AsRef::as_ref) {
        let error = |problem| DatasetError::new(path, problem);
        let mut source = Source::open(path)?;
        asked.map_or(Ok(()), |asked| source.check_environment(asked)).map_err(error)?;
        let mut recording = source.read(environment, task)?;
        let last = (0..recording.rows()).rfind(|row| recording.is_step(*row));
        if let Some(last) = last.filter(|_| paths.len() > 1) {
            recording.ends[last] = true;
        }
        check(path, &source, &recording).map_err(error)?;
        recording.unused_next_observations = None; // They only serve to check it.
        files.push(DatasetFile {
            path: path.to_owned(),
            sha256: None,
            transitions: recording.transitions().count() as u64,
            episodes: recording.episodes().len() as u64,
        });
        let own = traits(&source, &recording);
        match &first {
            None => (joined, first) = (recording, Some(own)),
            Some(first) => {
                let (other, mut pairs) = (files[0].path.clone(), own.into_iter().zip(first));
                let unlike = pairs.find(|((_, own), (_, theirs))| {
                    own != theirs && !own.is_empty() && !theirs.is_empty()
                });
                if let Some(((name, own), (_, theirs))) = unlike {
                    let difference = format!("{name}: {own}, not {theirs}");
                    return Err(error(Problem::Unlike(other, difference)));
                }
                joined.extend(&recording, 0..recording.rows());
                if joined.names == Names::default() {
                    joined.names = recording.names;
                }
            }
        }
    }
    Ok((joined, files))
}

/// Names and values of what files of one dataset have in common; empty where a file does not say it.
fn traits(source: &Source, recording: &Recording) -> [(&'static str, String); 7] {
    let environment = source.environment().as_deref().map(simulation_name);
    let names = &recording.names;
    let is_stored = recording.next_observations.is_some();
    let next = if is_stored { "stored" } else { "the next row's" };
    let goal = if recording.goal { "goes on" } else { "ends" };
    [
        ("environment", environment.unwrap_or_default()),
        ("numbers of observations", recording.observation_dim.to_string()),
        ("numbers of actions", recording.action_dim.to_string()),
        (OBSERVATION_NAMES, names.observations.join(", ")),
        (ACTION_NAMES, names.actions.join(", ")),
        ("next observations", next.to_owned()),
        ("an episode after its goal", goal.to_owned()),
    ]
}
