//! Transitions in memory, and the custom layout: HDF5 with one row per transition.

use std::path::Path;

use hdf5::types::VarLenUnicode;

use crate::checks;
use crate::error::{ArrayProblem, DatasetError, Problem};
use crate::formats::hdf5_file::Hdf5File;
use crate::formats::new_file::{NewFile, text};
use crate::recording::{ACTION_NAMES, Names, OBSERVATION_NAMES, Recording, RowKind};

/// Value of the root attribute `layout` that distinguishes this layout from D4RL's.
pub(super) const LAYOUT: &str = "transitions";

/// N transitions in memory, ordered by episode.
#[derive(Clone, Debug, Default)]
pub struct Arrays {
    /// Dimension of an observation, o.
    pub observation_dim: usize,
    /// Dimension of an action, a.
    pub action_dim: usize,
    /// s, N × o.
    pub observations: Vec<f32>,
    /// a, N × a, in any unit.
    pub actions: Vec<f32>,
    /// r, N.
    pub rewards: Vec<f32>,
    /// s', N × o.
    pub next_observations: Vec<f32>,
    /// True where the episode terminated, N.
    pub terminals: Vec<bool>,
    /// True where the episode was truncated, N.
    pub timeouts: Vec<bool>,
}

impl Arrays {
    pub(crate) fn into_recording(self) -> Result<Recording, Problem> {
        let (rows, o, a) = (self.rewards.len(), self.observation_dim, self.action_dim);
        for (array, width, length) in [
            ("observations", o, self.observations.len()),
            ("actions", a, self.actions.len()),
            ("next_observations", o, self.next_observations.len()),
            ("terminals", 1, self.terminals.len()),
            ("timeouts", 1, self.timeouts.len()),
        ] {
            if width == 0 {
                return Err(ArrayProblem::Axes(vec![rows, 0]).in_array(array));
            }
            if length != rows * width {
                return Err(ArrayProblem::Shape(vec![length], [rows, width]).in_array(array));
            }
        }
        let ends = (0..rows).map(|row| self.terminals[row] || self.timeouts[row]);
        let recording = Recording {
            observation_dim: o,
            action_dim: a,
            kinds: vec![RowKind::Transition; rows],
            ends: ends.collect(),
            observations: self.observations,
            actions: self.actions,
            rewards: self.rewards,
            next_observations: Some(self.next_observations),
            terminals: self.terminals,
            terminal_array: "terminals",
            timeouts: self.timeouts,
            ..Recording::default()
        };
        Ok(recording.with_jumps())
    }
}

/// Reads the custom layout. Terminals and timeouts end an episode; without `timeouts`, so does a
/// next observation that is not the state in which the following row starts.
pub(super) fn read_own(file: &Hdf5File) -> Result<Recording, Problem> {
    let observations = file.numbers("observations")?;
    let (rows, observation_dim) = (observations.rows(), observations.width);
    let actions = file.actions("actions")?.with_rows(rows)?;
    let has_timeouts = file.has("timeouts");
    let arrays = Arrays {
        observation_dim,
        action_dim: actions.width,
        observations: observations.values,
        actions: actions.values,
        rewards: file.table("rewards", rows, 1)?,
        next_observations: file.table("next_observations", rows, observation_dim)?,
        terminals: file.flags("terminals", rows)?,
        timeouts: match has_timeouts {
            true => file.flags("timeouts", rows)?,
            false => vec![false; rows],
        },
    };
    let mut recording = arrays.into_recording()?;
    if !has_timeouts {
        let ends = (0..rows).map(|row| recording.terminals[row] || recording.jumps(row));
        recording.ends = ends.collect();
    }
    recording.names.observations = file.names(OBSERVATION_NAMES, observation_dim)?;
    recording.names.actions = file.names(ACTION_NAMES, recording.action_dim)?;
    Ok(recording)
}

/// Writes the custom layout (docs/data.md) in compressed float32, with `names` as attributes.
/// Arrays that the reader would refuse are an error, except that actions may have any range. An
/// existing file is replaced once the new one is complete.
pub fn write_own(path: impl AsRef<Path>, arrays: Arrays, names: Names) -> Result<(), DatasetError> {
    let path = path.as_ref();
    let error = |problem| DatasetError::new(path, problem);
    let mut recording = arrays.into_recording().map_err(error)?;
    recording.names = names;
    if let Some(problem) = checks::problems(&recording, None).into_iter().next() {
        return Err(error(problem));
    }
    NewFile::write(path, |file| {
        let layout = file.hdf5.new_attr::<VarLenUnicode>().create("layout")?;
        layout.write_scalar(&text(LAYOUT)?)?;
        let names = &recording.names;
        for (attribute, names) in
            [(OBSERVATION_NAMES, &names.observations), (ACTION_NAMES, &names.actions)]
        {
            let texts = names.iter().map(|name| text(name));
            let texts = texts.collect::<hdf5::Result<Vec<_>>>()?;
            if !texts.is_empty() {
                let builder = file.hdf5.new_attr_builder();
                builder.with_data(&texts).create(attribute)?;
            }
        }
        let (o, a) = (Some(recording.observation_dim), Some(recording.action_dim));
        file.put("observations", o, &recording.observations)?;
        file.put("actions", a, &recording.actions)?;
        file.put("rewards", None, &recording.rewards)?;
        let next = recording.next_observations.as_deref();
        file.put("next_observations", o, next.unwrap_or_default())?;
        file.put("terminals", None, &recording.terminals)?;
        file.put("timeouts", None, &recording.timeouts)
    })
}
