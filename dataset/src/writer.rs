//! Writes D4RL's layout, in float32.

use std::path::Path;
use std::str::FromStr;

use hdf5::H5Type;
use hdf5::types::VarLenUnicode;

use crate::environment::EnvironmentSpec;
use crate::error::{DatasetError, Problem};
use crate::new_file::{CHUNK_ROWS, Column, NewFile};
use crate::recorded::Row;

/// Where the rows came from; ends up under `metadata/`.
#[derive(Clone, Debug)]
pub struct Metadata<'a> {
    /// What acted.
    pub algorithm: &'a str,
    /// Its last iteration.
    pub iteration: i64,
    /// The seed that makes the same file again.
    pub seed: u64,
}

/// A file that is being written. It appears under its name when [`finish`](Self::finish) says so, and not before:
/// until then it is `<path>.partial`, which the next writer of that path replaces.
pub struct D4rlWriter {
    environment: &'static EnvironmentSpec,
    file: NewFile,
    rows: usize,
    columns: Columns,
}

struct Columns {
    observations: Buffered<f32>,
    actions: Buffered<f32>,
    next_observations: Buffered<f32>,
    rewards: Buffered<f32>,
    terminals: Buffered<bool>,
    timeouts: Buffered<bool>,
    qpos: Buffered<f32>,
    qvel: Buffered<f32>,
}

/// A column, and rows that are not written yet: a chunk of them at most.
struct Buffered<T> {
    column: Column,
    buffer: Vec<T>,
}

impl D4rlWriter {
    /// Starts a file of `environment`'s sizes, and the folder it lies in.
    pub fn create(path: impl AsRef<Path>, environment: &'static EnvironmentSpec) -> Result<Self, DatasetError> {
        let file = NewFile::create(path.as_ref())?;
        let columns = Columns::create(&file, environment).map_err(|source| file.failed(source))?;
        Ok(Self { environment, file, rows: 0, columns })
    }

    /// Appends a row. Rows of other sizes and numbers that are not finite in float32 are refused.
    pub fn push(&mut self, row: &Row) -> Result<(), DatasetError> {
        let EnvironmentSpec { observation_dim, action_dim, qpos_dim, qvel_dim, .. } = *self.environment;
        let reward = [row.reward];
        let columns: [(&mut Buffered<f32>, &[f64], usize); 6] = [
            (&mut self.columns.observations, row.observation, observation_dim),
            (&mut self.columns.actions, row.action, action_dim),
            (&mut self.columns.next_observations, row.next_observation, observation_dim),
            (&mut self.columns.rewards, &reward, 1),
            (&mut self.columns.qpos, row.qpos, qpos_dim),
            (&mut self.columns.qvel, row.qvel, qvel_dim),
        ];
        for (column, values, width) in &columns {
            let problem = if values.len() != *width {
                format!("has {} numbers, but must have {width}", values.len())
            } else if let Some(value) = values.iter().find(|&&value| !(value as f32).is_finite()) {
                format!("has {value}, which is not a finite float32")
            } else {
                continue;
            };
            let problem = Problem::BadRow { row: self.rows, array: column.column.name, problem };
            return Err(DatasetError::new(self.file.path(), problem));
        }
        for (column, values, _) in columns {
            column.buffer.extend(values.iter().map(|&value| value as f32));
        }
        self.columns.terminals.buffer.push(row.terminal);
        self.columns.timeouts.buffer.push(row.timeout);
        self.rows += 1;
        if self.rows.is_multiple_of(CHUNK_ROWS) { self.flush() } else { Ok(()) }
    }

    /// Rows so far.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Writes what is left and gives the file its name.
    pub fn finish(mut self, metadata: &Metadata) -> Result<(), DatasetError> {
        self.flush()?;
        self.write_metadata(metadata).map_err(|source| self.file.failed(source))?;
        let Self { file, columns, .. } = self;
        drop(columns);
        file.finish()
    }

    fn write_metadata(&self, metadata: &Metadata) -> hdf5::Result<()> {
        let text = |value: &str| VarLenUnicode::from_str(value).map_err(|error| error.to_string());
        let group = self.file.hdf5.create_group("metadata")?;
        group.new_dataset::<VarLenUnicode>().create("algorithm")?.write_scalar(&text(metadata.algorithm)?)?;
        group.new_dataset::<VarLenUnicode>().create("environment")?.write_scalar(&text(&self.environment.name)?)?;
        group.new_dataset::<i64>().create("iteration")?.write_scalar(&metadata.iteration)?;
        group.new_dataset::<u64>().create("seed")?.write_scalar(&metadata.seed)
    }

    fn flush(&mut self) -> Result<(), DatasetError> {
        self.columns.flush().map_err(|source| self.file.failed(source))
    }
}

impl Columns {
    fn create(file: &NewFile, environment: &EnvironmentSpec) -> hdf5::Result<Self> {
        file.hdf5.create_group("infos")?;
        let EnvironmentSpec { observation_dim, action_dim, qpos_dim, qvel_dim, .. } = *environment;
        Ok(Self {
            observations: Buffered::create(file, "observations", Some(observation_dim))?,
            actions: Buffered::create(file, "actions", Some(action_dim))?,
            next_observations: Buffered::create(file, "next_observations", Some(observation_dim))?,
            rewards: Buffered::create(file, "rewards", None)?,
            terminals: Buffered::create(file, "terminals", None)?,
            timeouts: Buffered::create(file, "timeouts", None)?,
            qpos: Buffered::create(file, "infos/qpos", Some(qpos_dim))?,
            qvel: Buffered::create(file, "infos/qvel", Some(qvel_dim))?,
        })
    }

    fn flush(&mut self) -> hdf5::Result<()> {
        let Self { observations, actions, next_observations, rewards, terminals, timeouts, qpos, qvel } = self;
        for floats in [observations, actions, next_observations, rewards, qpos, qvel] {
            floats.flush()?;
        }
        [terminals, timeouts].into_iter().try_for_each(Buffered::flush)
    }
}

impl<T: H5Type> Buffered<T> {
    fn create(file: &NewFile, name: &'static str, width: Option<usize>) -> hdf5::Result<Self> {
        Ok(Self { column: Column::create::<T>(file, name, width)?, buffer: Vec::new() })
    }

    fn flush(&mut self) -> hdf5::Result<()> {
        self.column.append(&self.buffer)?;
        self.buffer.clear();
        Ok(())
    }
}
