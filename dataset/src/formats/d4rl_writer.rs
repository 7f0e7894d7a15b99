//! Writer of D4RL's layout, in float32.

use std::path::Path;

use hdf5::H5Type;

use crate::error::{DatasetError, Problem, RowProblem};
use crate::formats::new_file::{CHUNK_ROWS, Column, NewFile, text};
use crate::formats::recorded::RecordedStep;
use crate::online::OnlineEpisode;
use crate::tables::environment::EnvironmentSpec;

/// Origin of the rows, stored under `metadata/`.
#[derive(Clone, Debug, Default)]
pub struct Metadata<'a> {
    /// Name of the algorithm that acted.
    pub algorithm: &'a str,
    /// Last iteration of the algorithm.
    pub iteration: i64,
    /// Seed that reproduces the file.
    pub seed: u64,
    /// Run of the policy that acted, if a policy of a run did.
    pub run: Option<&'a str>,
    /// BLAKE3 of the policy's file.
    pub weights: Option<&'a str>,
}

/// File being written, at `<path>.partial` until [`finish`](Self::finish) renames it. An unfinished
/// file of the same path is replaced.
pub struct D4rlWriter {
    environment: &'static EnvironmentSpec,
    file: NewFile,
    rows: usize,
    /// Each with up to one chunk of rows not yet written.
    columns: Vec<(Column, Vec<f32>)>,
}

fn is_flag(array: &str) -> bool {
    matches!(array, "terminals" | "timeouts")
}

impl D4rlWriter {
    /// Starts a file of `environment`'s dimensions, creating missing folders.
    pub fn create(
        path: impl AsRef<Path>,
        environment: &'static EnvironmentSpec,
    ) -> Result<Self, DatasetError> {
        let file = NewFile::create(path.as_ref())?;
        let [o, a] = [environment.observation_dim, environment.action_dim].map(Some);
        let create = |(name, width)| {
            let column = match is_flag(name) {
                true => Column::create::<bool>(&file, name, width)?,
                false => Column::create::<f32>(&file, name, width)?,
            };
            Ok((column, Vec::new()))
        };
        let columns = file.hdf5.create_group("infos").and_then(|_| {
            let columns = [
                ("observations", o),
                ("actions", a),
                ("next_observations", o),
                ("rewards", None),
                ("infos/qpos", Some(environment.qpos_dim)),
                ("infos/qvel", Some(environment.qvel_dim)),
                ("terminals", None),
                ("timeouts", None),
            ];
            columns.into_iter().map(create).collect()
        });
        let columns = columns.map_err(|source| file.failed(source))?;
        Ok(Self { environment, file, rows: 0, columns })
    }

    /// Appends a step. Other dimensions and numbers not finite in float32 are refused.
    pub fn push(&mut self, step: &RecordedStep) -> Result<(), DatasetError> {
        let number = |flag: bool| [f64::from(u8::from(flag))];
        // In the order of the columns.
        let values = [
            step.observation,
            step.action,
            step.next_observation,
            &[step.reward],
            step.qpos,
            step.qvel,
            &number(step.terminal),
            &number(step.timeout),
        ];
        for ((column, _), values) in self.columns.iter().zip(values) {
            let checked = self.check(column, values);
            checked.map_err(|problem| DatasetError::new(self.file.path(), problem))?;
        }
        for ((_, buffer), values) in self.columns.iter_mut().zip(values) {
            buffer.extend(values.iter().map(|&value| value as f32));
        }
        self.rows += 1;
        match self.rows.is_multiple_of(CHUNK_ROWS) {
            true => self.flush(),
            false => Ok(()),
        }
    }

    fn check(&self, column: &Column, values: &[f64]) -> Result<(), Problem> {
        let (array, width, expected) = (column.name, values.len(), column.width.unwrap_or(1));
        if width != expected {
            let environment = self.environment.name.clone();
            return Err(Problem::Width(array, width, environment, expected));
        }
        let mut values = values.iter().map(|value| *value as f32);
        match values.find(|value| !value.is_finite()) {
            Some(value) => Err(RowProblem::NotFinite(value).in_row(array, self.rows)),
            None => Ok(()),
        }
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
        for (column, buffer) in &mut self.columns {
            let flags = || Vec::from_iter(buffer.iter().map(|value| *value == 1.0));
            let appended = match is_flag(column.name) {
                true => column.append(&flags()),
                false => column.append(buffer),
            };
            appended.map_err(|source| self.file.failed(source))?;
            buffer.clear();
        }
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
    for (name, value) in [("run", metadata.run), ("weights", metadata.weights)] {
        if let Some(value) = value {
            put(&group, name, &text(value)?)?;
        }
    }
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
    let [mut observations, mut next_observations] = [const { Vec::new() }; 2];
    let [mut actions, mut rewards] = [const { Vec::new() }; 2];
    let [mut terminals, mut timeouts, mut interventions] = [const { Vec::new() }; 3];
    for (rows, acted) in episodes {
        let error = |problem| DatasetError::new(path, problem);
        let n = rows.steps(o, a).map_err(error)?;
        observations.extend_from_slice(&rows.observations[..n * o]);
        actions.extend_from_slice(rows.actions);
        next_observations.extend_from_slice(&rows.observations[o..]);
        rewards.extend_from_slice(rows.rewards);
        terminals.extend((1..=n).map(|step| step == n && rows.terminated));
        timeouts.extend((1..=n).map(|step| step == n && !rows.terminated));
        interventions.extend((0..n as u32).map(|step| acted.binary_search(&step).is_ok()));
    }
    NewFile::write(path, |file| {
        file.put("observations", Some(o), &observations)?;
        file.put("actions", Some(a), &actions)?;
        file.put("next_observations", Some(o), &next_observations)?;
        file.put("rewards", None, &rewards)?;
        file.put("terminals", None, &terminals)?;
        file.put("timeouts", None, &timeouts)?;
        if interventions.contains(&true) {
            file.hdf5.create_group("infos")?;
            file.put("infos/intervention", None, &interventions)?;
        }
        write_metadata(file, environment, metadata)
    })
}
