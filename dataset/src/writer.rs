//! Writes D4RL's layout: float32, gzip 4, chunked, booleans as h5py writes them.

use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use hdf5::types::VarLenUnicode;
use hdf5::{H5Type, Hyperslab, SliceOrIndex};
use ndarray::ArrayViewD;

use crate::environment::EnvironmentSpec;
use crate::error::{DatasetError, Problem};
use crate::recorded::Row;

/// Rows in a chunk, and in the buffer before it is written: a few hundred kilobytes in all.
const CHUNK_ROWS: usize = 4096;

/// D4RL's.
const GZIP_LEVEL: u8 = 4;

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
    path: PathBuf,
    partial: PathBuf,
    environment: &'static EnvironmentSpec,
    file: hdf5::File,
    rows: usize,
    observations: Column<f32>,
    actions: Column<f32>,
    next_observations: Column<f32>,
    rewards: Column<f32>,
    terminals: Column<bool>,
    timeouts: Column<bool>,
    qpos: Column<f32>,
    qvel: Column<f32>,
}

impl D4rlWriter {
    /// Starts a file of `environment`'s sizes, and the folder it lies in.
    pub fn create(path: impl AsRef<Path>, environment: &'static EnvironmentSpec) -> Result<Self, DatasetError> {
        let path = path.as_ref().to_owned();
        let mut partial = path.clone().into_os_string();
        partial.push(".partial");
        let partial = PathBuf::from(partial);
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(|source| DatasetError::new(&path, Problem::Io(source)))?;
        }
        let create = || -> hdf5::Result<Self> {
            let file = hdf5::File::create(&partial)?;
            file.create_group("infos")?;
            let EnvironmentSpec { observation_dim, action_dim, qpos_dim, qvel_dim, .. } = *environment;
            Ok(Self {
                environment,
                rows: 0,
                observations: Column::create(&file, "observations", Some(observation_dim))?,
                actions: Column::create(&file, "actions", Some(action_dim))?,
                next_observations: Column::create(&file, "next_observations", Some(observation_dim))?,
                rewards: Column::create(&file, "rewards", None)?,
                terminals: Column::create(&file, "terminals", None)?,
                timeouts: Column::create(&file, "timeouts", None)?,
                qpos: Column::create(&file, "infos/qpos", Some(qpos_dim))?,
                qvel: Column::create(&file, "infos/qvel", Some(qvel_dim))?,
                path: path.clone(),
                partial: partial.clone(),
                file,
            })
        };
        create().map_err(|source| DatasetError::new(&path, Problem::Write(source)))
    }

    /// Appends a row. Rows of other sizes and numbers that are not finite in float32 are refused.
    pub fn push(&mut self, row: &Row) -> Result<(), DatasetError> {
        let EnvironmentSpec { observation_dim, action_dim, qpos_dim, qvel_dim, .. } = *self.environment;
        let reward = [row.reward];
        let columns: [(&mut Column<f32>, &[f64], usize); 6] = [
            (&mut self.observations, row.observation, observation_dim),
            (&mut self.actions, row.action, action_dim),
            (&mut self.next_observations, row.next_observation, observation_dim),
            (&mut self.rewards, &reward, 1),
            (&mut self.qpos, row.qpos, qpos_dim),
            (&mut self.qvel, row.qvel, qvel_dim),
        ];
        for (column, values, width) in &columns {
            let problem = if values.len() != *width {
                format!("has {} numbers, but must have {width}", values.len())
            } else if let Some(value) = values.iter().find(|&&value| !(value as f32).is_finite()) {
                format!("has {value}, which is not a finite float32")
            } else {
                continue;
            };
            let problem = Problem::BadRow { row: self.rows, array: column.name, problem };
            return Err(DatasetError::new(&self.path, problem));
        }
        for (column, values, _) in columns {
            column.buffer.extend(values.iter().map(|&value| value as f32));
        }
        self.terminals.buffer.push(row.terminal);
        self.timeouts.buffer.push(row.timeout);
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
        self.write_metadata(metadata).map_err(|source| self.failed(source))?;
        let Self { path, partial, .. } = self; // Drops, and so closes, every handle of the file.
        fs::File::open(&partial)
            .and_then(|file| file.sync_all())
            .and_then(|()| fs::rename(&partial, &path))
            .map_err(|source| DatasetError::new(path, Problem::Io(source)))
    }

    fn write_metadata(&self, metadata: &Metadata) -> hdf5::Result<()> {
        let text = |value: &str| VarLenUnicode::from_str(value).map_err(|error| error.to_string());
        let group = self.file.create_group("metadata")?;
        group.new_dataset::<VarLenUnicode>().create("algorithm")?.write_scalar(&text(metadata.algorithm)?)?;
        group.new_dataset::<VarLenUnicode>().create("environment")?.write_scalar(&text(&self.environment.name)?)?;
        group.new_dataset::<i64>().create("iteration")?.write_scalar(&metadata.iteration)?;
        group.new_dataset::<u64>().create("seed")?.write_scalar(&metadata.seed)
    }

    fn flush(&mut self) -> Result<(), DatasetError> {
        let floats = [
            &mut self.observations,
            &mut self.actions,
            &mut self.next_observations,
            &mut self.rewards,
            &mut self.qpos,
            &mut self.qvel,
        ];
        let flags = [&mut self.terminals, &mut self.timeouts];
        let written = floats
            .into_iter()
            .try_for_each(|column| column.flush(self.rows))
            .and_then(|()| flags.into_iter().try_for_each(|column| column.flush(self.rows)));
        written.map_err(|source| self.failed(source))
    }

    fn failed(&self, source: hdf5::Error) -> DatasetError {
        DatasetError::new(&self.partial, Problem::Write(source))
    }
}

/// An array that grows by rows: N, or N × width.
struct Column<T> {
    name: &'static str,
    width: Option<usize>,
    dataset: hdf5::Dataset,
    buffer: Vec<T>,
}

impl<T: H5Type> Column<T> {
    fn create(file: &hdf5::File, name: &'static str, width: Option<usize>) -> hdf5::Result<Self> {
        let builder = file.new_dataset::<T>().deflate(GZIP_LEVEL);
        let dataset = match width {
            None => builder.chunk((CHUNK_ROWS,)).shape((0..,)).create(name)?,
            Some(width) => builder.chunk((CHUNK_ROWS, width)).shape((0.., width)).create(name)?,
        };
        Ok(Self { name, width, dataset, buffer: Vec::new() })
    }

    /// Appends the buffer, after which the array has `rows` rows.
    fn flush(&mut self, rows: usize) -> hdf5::Result<()> {
        let shape = |rows: usize| -> Vec<usize> { [rows].into_iter().chain(self.width).collect() };
        let new = self.buffer.len() / self.width.unwrap_or(1);
        let view = ArrayViewD::from_shape(shape(new), &self.buffer)?;
        self.dataset.resize(shape(rows))?;
        let mut slab = vec![SliceOrIndex::from(rows - new..rows)];
        slab.extend(self.width.map(|width| SliceOrIndex::from(0..width)));
        self.dataset.write_slice(view, Hyperslab::from(slab))?;
        self.buffer.clear();
        Ok(())
    }
}
