//! Writer of D4RL's layout, in float32.

use std::path::Path;

use hdf5::H5Type;

use crate::error::{DatasetError, Problem, RowProblem};
use crate::formats::new_file::{CHUNK_ROWS, Column, NewFile, text};
use crate::formats::recorded::Row;
use crate::online::OnlineEpisode;
use crate::tables::environment::EnvironmentSpec;

/// Origin of the rows, stored under `metadata/`.
#[derive(Clone, Debug)]
pub struct Metadata<'a> {
    /// Name of the algorithm that acted.
    pub algorithm: &'a str,
    /// Last iteration of the algorithm.
    pub iteration: i64,
    /// Seed that reproduces the file.
    pub seed: u64,
}

/// File being written, at `<path>.partial` until [`finish`](Self::finish) renames it. An unfinished
/// file of the same path is replaced.
pub struct D4rlWriter {
    environment: &'static EnvironmentSpec,
    file: NewFile,
    rows: usize,
    columns: Vec<Buffered>,
}

/// Column with up to one chunk of rows not yet written.
struct Buffered {
    column: Column,
    is_flag: bool,
    buffer: Vec<f32>,
}

impl D4rlWriter {
    /// Starts a file of `environment`'s dimensions, creating missing folders.
    pub fn create(
        path: impl AsRef<Path>,
        environment: &'static EnvironmentSpec,
    ) -> Result<Self, DatasetError> {
        let file = NewFile::create(path.as_ref())?;
        let columns = columns(&file, environment).map_err(|source| file.failed(source))?;
        Ok(Self { environment, file, rows: 0, columns })
    }

    /// Appends a row. Other dimensions and numbers not finite in float32 are refused.
    pub fn push(&mut self, row: &Row) -> Result<(), DatasetError> {
        let number = |flag: bool| [f64::from(u8::from(flag))];
        // In the order of `columns`.
        let values = [
            row.observation,
            row.action,
            row.next_observation,
            &[row.reward],
            row.qpos,
            row.qvel,
            &number(row.terminal),
            &number(row.timeout),
        ];
        let problem = self
            .columns
            .iter()
            .zip(values)
            .find_map(|(column, values)| self.problem(&column.column, values));
        if let Some(problem) = problem {
            return Err(DatasetError::new(self.file.path(), problem));
        }
        for (column, values) in self.columns.iter_mut().zip(values) {
            column.buffer.extend(values.iter().map(|&value| value as f32));
        }
        self.rows += 1;
        if self.rows.is_multiple_of(CHUNK_ROWS) { self.flush() } else { Ok(()) }
    }

    fn problem(&self, column: &Column, values: &[f64]) -> Option<Problem> {
        let (array, found, expected) = (column.name, values.len(), column.width.unwrap_or(1));
        if found != expected {
            let environment = self.environment.name.clone();
            return Some(Problem::Width(array, found, environment, expected));
        }
        let value = values.iter().map(|value| *value as f32).find(|value| !value.is_finite())?;
        Some(RowProblem::NotFinite(value).at(array, self.rows))
    }

    /// Number of rows so far.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Writes the remaining rows and renames the file.
    pub fn finish(mut self, metadata: &Metadata) -> Result<(), DatasetError> {
        self.flush()?;
        let written = write_metadata(&self.file, &self.environment.name, metadata);
        written.map_err(|source| self.file.failed(source))?;
        drop(self.columns);
        self.file.finish()
    }

    fn flush(&mut self) -> Result<(), DatasetError> {
        let flushed = self.columns.iter_mut().try_for_each(Buffered::flush);
        flushed.map_err(|source| self.file.failed(source))
    }
}

fn columns(file: &NewFile, spec: &EnvironmentSpec) -> hdf5::Result<Vec<Buffered>> {
    file.hdf5.create_group("infos")?;
    let (o, a) = (Some(spec.observation_dim), Some(spec.action_dim));
    let columns = [
        ("observations", o),
        ("actions", a),
        ("next_observations", o),
        ("rewards", None),
        ("infos/qpos", Some(spec.qpos_dim)),
        ("infos/qvel", Some(spec.qvel_dim)),
        ("terminals", None),
        ("timeouts", None),
    ];
    let create = |(name, width)| {
        let is_flag = matches!(name, "terminals" | "timeouts");
        let column = match is_flag {
            true => Column::create::<bool>(file, name, width)?,
            false => Column::create::<f32>(file, name, width)?,
        };
        let buffer = Vec::new();
        Ok(Buffered { column, is_flag, buffer })
    };
    columns.into_iter().map(create).collect()
}

impl Buffered {
    fn flush(&mut self) -> hdf5::Result<()> {
        let flags = || Vec::from_iter(self.buffer.iter().map(|value| *value == 1.0));
        match self.is_flag {
            true => self.column.append(&flags())?,
            false => self.column.append(&self.buffer)?,
        }
        self.buffer.clear();
        Ok(())
    }
}

fn write_metadata(file: &NewFile, environment: &str, metadata: &Metadata) -> hdf5::Result<()> {
    fn put<T: H5Type>(group: &hdf5::Group, name: &str, value: &T) -> hdf5::Result<()> {
        group.new_dataset::<T>().create(name)?.write_scalar(value)
    }
    let group = file.hdf5.create_group("metadata")?;
    put(&group, "algorithm", &text(metadata.algorithm)?)?;
    put(&group, "environment", &text(environment)?)?;
    put(&group, "iteration", &metadata.iteration)?;
    put(&group, "seed", &metadata.seed)
}

/// Writes online episodes in an environment of these sizes of observation and action, without
/// the simulator's state. Each comes with the steps, in ascending order, at which a person acted;
/// if there are any, `infos/intervention` marks them. An existing file is replaced once the new one
/// is complete.
pub fn write_experience(
    path: impl AsRef<Path>,
    environment: &str,
    (o, a): (usize, usize),
    metadata: &Metadata,
    episodes: &[(OnlineEpisode<'_>, &[u32])],
) -> Result<(), DatasetError> {
    let path = path.as_ref();
    let [mut observations, mut actions, mut next_observations, mut rewards] =
        [const { Vec::new() }; 4];
    let [mut terminals, mut timeouts, mut interventions] = [const { Vec::new() }; 3];
    for (rows, acted) in episodes {
        let n = rows.steps(o, a).map_err(|problem| DatasetError::new(path, problem))?;
        observations.extend_from_slice(&rows.observations[..n * o]);
        actions.extend_from_slice(rows.actions);
        next_observations.extend_from_slice(&rows.observations[o..]);
        rewards.extend_from_slice(rows.rewards);
        terminals.extend((1..=n).map(|step| step == n && rows.terminated));
        timeouts.extend((1..=n).map(|step| step == n && !rows.terminated));
        interventions.extend((0..n as u32).map(|step| acted.binary_search(&step).is_ok()));
    }
    let file = NewFile::create(path)?;
    let write = || {
        for (name, width, values) in [
            ("observations", Some(o), &observations),
            ("actions", Some(a), &actions),
            ("next_observations", Some(o), &next_observations),
            ("rewards", None, &rewards),
        ] {
            Column::create::<f32>(&file, name, width)?.append(values)?;
        }
        for (name, flags) in [("terminals", &terminals), ("timeouts", &timeouts)] {
            Column::create::<bool>(&file, name, None)?.append(flags)?;
        }
        if interventions.contains(&true) {
            file.hdf5.create_group("infos")?;
            Column::create::<bool>(&file, "infos/intervention", None)?.append(&interventions)?;
        }
        write_metadata(&file, environment, metadata)
    };
    write().map_err(|source| file.failed(source))?;
    file.finish()
}
