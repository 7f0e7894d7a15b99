//! Writer of D4RL's layout, in float32.

use std::path::Path;
use std::str::FromStr;

use hdf5::H5Type;
use hdf5::types::VarLenUnicode;

use crate::error::{DatasetError, Problem, RowProblem};
use crate::formats::new_file::{CHUNK_ROWS, Column, NewFile};
use crate::formats::recorded::Row;
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
    floats: Vec<Buffered<f32>>,
    flags: Vec<Buffered<bool>>,
}

/// Numeric columns, in the order in which `push` writes them.
const FLOATS: [&str; 6] =
    ["observations", "actions", "next_observations", "rewards", "infos/qpos", "infos/qvel"];
const FLAGS: [&str; 2] = ["terminals", "timeouts"];

/// Column with up to one chunk of rows not yet written.
struct Buffered<T> {
    column: Column,
    buffer: Vec<T>,
}

impl D4rlWriter {
    /// Starts a file of `environment`'s dimensions, creating missing folders.
    pub fn create(
        path: impl AsRef<Path>,
        environment: &'static EnvironmentSpec,
    ) -> Result<Self, DatasetError> {
        let file = NewFile::create(path.as_ref())?;
        let EnvironmentSpec { observation_dim: o, action_dim: a, qpos_dim, qvel_dim, .. } =
            *environment;
        let widths = [Some(o), Some(a), Some(o), None, Some(qpos_dim), Some(qvel_dim)];
        let columns = || -> hdf5::Result<_> {
            file.hdf5.create_group("infos")?;
            let floats =
                FLOATS.iter().zip(widths).map(|(name, width)| Buffered::create(&file, name, width));
            let flags = FLAGS.iter().map(|name| Buffered::create(&file, name, None));
            Ok((floats.collect::<hdf5::Result<_>>()?, flags.collect::<hdf5::Result<_>>()?))
        };
        let (floats, flags) = columns().map_err(|source| file.failed(source))?;
        Ok(Self { environment, file, rows: 0, floats, flags })
    }

    /// Appends a row. Other dimensions and numbers not finite in float32 are refused.
    pub fn push(&mut self, row: &Row) -> Result<(), DatasetError> {
        let reward = [row.reward];
        let values =
            [row.observation, row.action, row.next_observation, &reward, row.qpos, row.qvel];
        for (Buffered { column, .. }, values) in self.floats.iter().zip(values) {
            let (array, expected) = (column.name, column.width.unwrap_or(1));
            let not_finite = values.iter().map(|value| *value as f32).find(|x| !x.is_finite());
            let problem = match not_finite.map(RowProblem::NotFinite) {
                _ if values.len() != expected => {
                    let environment = self.environment.name.clone();
                    Problem::Width { array, found: values.len(), expected, environment }
                }
                Some(problem) => {
                    Problem::Rows { array: array.to_owned(), row: self.rows, rows: 1, problem }
                }
                None => continue,
            };
            return Err(DatasetError::new(self.file.path(), problem));
        }
        for (column, values) in self.floats.iter_mut().zip(values) {
            column.buffer.extend(values.iter().map(|&value| value as f32));
        }
        for (column, flag) in self.flags.iter_mut().zip([row.terminal, row.timeout]) {
            column.buffer.push(flag);
        }
        self.rows += 1;
        if self.rows.is_multiple_of(CHUNK_ROWS) { self.flush() } else { Ok(()) }
    }

    /// Number of rows so far.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Writes the remaining rows and renames the file.
    pub fn finish(mut self, metadata: &Metadata) -> Result<(), DatasetError> {
        self.flush()?;
        self.write_metadata(metadata).map_err(|source| self.file.failed(source))?;
        let Self { file, floats, flags, .. } = self;
        drop((floats, flags));
        file.finish()
    }

    fn write_metadata(&self, metadata: &Metadata) -> hdf5::Result<()> {
        let group = self.file.hdf5.create_group("metadata")?;
        for (name, value) in
            [("algorithm", metadata.algorithm), ("environment", &self.environment.name)]
        {
            let value = VarLenUnicode::from_str(value).map_err(|error| error.to_string())?;
            group.new_dataset::<VarLenUnicode>().create(name)?.write_scalar(&value)?;
        }
        group.new_dataset::<i64>().create("iteration")?.write_scalar(&metadata.iteration)?;
        group.new_dataset::<u64>().create("seed")?.write_scalar(&metadata.seed)
    }

    fn flush(&mut self) -> Result<(), DatasetError> {
        let floats = self.floats.iter_mut().try_for_each(Buffered::flush);
        let flushed = floats.and_then(|()| self.flags.iter_mut().try_for_each(Buffered::flush));
        flushed.map_err(|source| self.file.failed(source))
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
