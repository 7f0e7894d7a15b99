//! Files that are one dataset, one after the other.

use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::error::{DatasetError, Problem};
use crate::formats::Source;
use crate::recording::{ACTION_NAMES, OBSERVATION_NAMES, Recording};
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

/// The environment that files name, if any does. Refuses a file of another environment than that
/// asked for, or than a file before it.
pub(crate) fn environment(
    paths: &[impl AsRef<Path>],
    asked: Option<&EnvironmentSpec>,
) -> Result<Option<String>, DatasetError> {
    let mut first: Option<(&Path, String)> = None;
    for path in paths.iter().map(AsRef::as_ref) {
        let (source, error) = (Source::open(path)?, |problem| DatasetError::new(path, problem));
        asked.map_or(Ok(()), |asked| source.check_environment(asked)).map_err(error)?;
        match (&first, source.environment()) {
            (Some((other, theirs)), Some(own))
                if simulation_name(&own) != simulation_name(theirs) =>
            {
                let difference = format!("recorded in `{own}`, not in `{theirs}`");
                return Err(error(Problem::Unlike(other.to_path_buf(), difference)));
            }
            (None, Some(own)) => first = Some((path, own)),
            _ => {}
        }
    }
    Ok(first.map(|(_, name)| name))
}

/// Reads files as one recording. Each is read and passed to `check` as if it were alone, and its end
/// ends its last episode.
pub(crate) fn read(
    paths: &[impl AsRef<Path>],
    environment: Option<&EnvironmentSpec>,
    task: Option<MazeTask>,
    mut check: impl FnMut(&Path, &Source, &Recording) -> Result<(), Problem>,
) -> Result<(Recording, Vec<DatasetFile>), DatasetError> {
    let (mut joined, mut files) = (Recording::default(), Vec::<DatasetFile>::new());
    for path in paths.iter().map(AsRef::as_ref) {
        let error = |problem| DatasetError::new(path, problem);
        let mut source = Source::open(path)?;
        let mut recording = source.read(environment, task)?;
        let last = (0..recording.rows()).rfind(|row| recording.is_step(*row));
        if let Some(last) = last.filter(|_| paths.len() > 1) {
            recording.ends[last] = true;
        }
        check(path, &source, &recording).map_err(error)?;
        let transitions = recording.transitions().count() as u64;
        let (episodes, path) = (recording.episodes().len() as u64, path.to_owned());
        match files.first() {
            None => joined = recording,
            Some(first) => {
                let unlike = |difference| Problem::Unlike(first.path.clone(), difference);
                difference(&recording, &joined).map_or(Ok(()), |text| Err(error(unlike(text))))?;
                joined.join(recording);
            }
        }
        files.push(DatasetFile { path, sha256: None, transitions, episodes });
    }
    Ok((joined, files))
}

/// A sentence about a file, with its name if there are others.
pub(crate) fn name(paths: &[impl AsRef<Path>], path: &Path, sentence: String) -> String {
    match paths.len() {
        1 => sentence,
        _ => format!("{}: {sentence}", path.display()),
    }
}

/// Why the rows of two recordings are not alike. Columns without names are taken for those of the
/// other.
fn difference(own: &Recording, other: &Recording) -> Option<String> {
    for (array, width, theirs) in [
        ("observations", own.observation_dim, other.observation_dim),
        ("actions", own.action_dim, other.action_dim),
    ] {
        if width != theirs {
            return Some(format!("`{array}` has {width} numbers a row, not {theirs}"));
        }
    }
    for (attribute, names, theirs) in [
        (OBSERVATION_NAMES, &own.names.observations, &other.names.observations),
        (ACTION_NAMES, &own.names.actions, &other.names.actions),
    ] {
        if let Some(column) = names.iter().zip(theirs).position(|(own, other)| own != other) {
            let (name, theirs) = (&names[column], &theirs[column]);
            return Some(format!("`{attribute}` has {name:?} for column {column}, not {theirs:?}"));
        }
    }
    (own.goal != other.goal).then(|| "only one of them goes on after its goal".to_owned())
}

impl Recording {
    /// Appends the rows of another file.
    fn join(&mut self, mut other: Self) {
        if self.next_observations.is_some() != other.next_observations.is_some() {
            self.store_next_observations();
            other.store_next_observations();
        }
        for recording in [&mut *self, &mut other] {
            recording.unused_next_observations = None;
            if recording.next_observations.is_none() {
                recording.jumps.clear();
            }
        }
        self.extend(&other, 0..other.rows());
        for (names, theirs) in [
            (&mut self.names.observations, other.names.observations),
            (&mut self.names.actions, other.names.actions),
        ] {
            if names.is_empty() {
                *names = theirs;
            }
        }
    }

    /// Stores the following row's observation as the next one, if none is stored.
    fn store_next_observations(&mut self) {
        if self.next_observations.is_none() {
            let mut next =
                Vec::from_iter(self.observations.iter().copied().skip(self.observation_dim));
            next.resize(self.observations.len(), 0.0); // The last row starts no transition.
            (self.next_observations, self.jumps) = (Some(next), vec![false; self.rows()]);
        }
    }
}
