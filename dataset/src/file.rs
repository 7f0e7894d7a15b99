//! Arrays of an HDF5 file, each checked for presence, type, shape, size and finite values before anybody uses it.
//!
//! Damage to HDF5's own structures is libhdf5's to find, and its 1.10 does not survive all of it: a dataset is to come
//! from a place that is trusted.

use std::fs;
use std::path::{Path, PathBuf};

use hdf5::H5Type;
use hdf5::types::{FloatSize, TypeDescriptor, VarLenUnicode};

use crate::DatasetError;

/// deflate shrinks by a factor of 1032 at most, so more than that in an array is a lie about its size.
const MAX_COMPRESSION: u64 = 1040;

/// The largest integer type that HDF5's own tools use for an enum.
const MAX_FLAG_BYTES: usize = 8;

/// An open HDF5 file with D4RL's arrays at its root.
pub(crate) struct DatasetFile {
    path: PathBuf,
    file: hdf5::File,
    bytes: u64,
    rows: usize,
}

impl DatasetFile {
    /// Opens a file. The number of its rows is what `observations` says.
    pub(crate) fn open(path: &Path) -> Result<Self, DatasetError> {
        let bytes = fs::File::open(path)
            .and_then(|file| file.metadata())
            .map_err(|source| DatasetError::Io { path: path.into(), source })?
            .len();
        let file = hdf5::File::open(path).map_err(|source| DatasetError::NotHdf5 { path: path.into(), source })?;
        let mut this = Self { path: path.into(), file, bytes, rows: 0 };
        let shape = this.array("observations")?.shape();
        this.rows = shape.first().copied().unwrap_or(0);
        Ok(this)
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn rows(&self) -> usize {
        self.rows
    }

    pub(crate) fn has(&self, array: &str) -> bool {
        self.file.link_exists(array)
    }

    /// A text that stands in the file as an array of its own, without axes.
    pub(crate) fn text(&self, array: &str) -> Option<String> {
        let text = self.file.dataset(array).ok()?.read_scalar::<VarLenUnicode>().ok()?;
        Some(text.as_str().to_owned())
    }

    /// Numbers in a row of an array.
    pub(crate) fn width(&self, array: &'static str) -> Result<usize, DatasetError> {
        match self.array(array)?.shape()[..] {
            [_] => Ok(1),
            [_, width] if width > 0 => Ok(width),
            ref found => {
                let (path, found) = (self.path.clone(), found.to_vec());
                Err(DatasetError::Shape { path, array, found, expected: vec![self.rows, 1] })
            }
        }
    }

    /// An array of `rows × width` numbers, row by row. A width of 1 may also be written without its axis.
    pub(crate) fn numbers<T: H5Type + Copy + Into<f64>>(
        &self,
        array: &'static str,
        width: usize,
    ) -> Result<Vec<T>, DatasetError> {
        let dataset = self.array(array)?;
        let expected = "float32 or float64";
        match self.descriptor(&dataset, array, expected)? {
            TypeDescriptor::Float(FloatSize::U4 | FloatSize::U8) => {}
            other => return Err(self.wrong_type(array, other.to_string(), expected)),
        }
        self.check_shape(&dataset, array, width)?;
        let values = dataset.read_raw::<T>().map_err(|source| self.unreadable(array, source))?;
        match values.iter().position(|&value| !value.into().is_finite()) {
            None => Ok(values),
            Some(i) => {
                let (path, value) = (self.path.clone(), values[i].into());
                Err(DatasetError::NotFinite { path, array, row: i / width, value })
            }
        }
    }

    /// An array of one flag a row: an enum (h5py's bool) or an integer.
    pub(crate) fn flags(&self, array: &'static str) -> Result<Vec<bool>, DatasetError> {
        let dataset = self.array(array)?;
        let expected = "booleans (h5py's enum, or an integer type)";
        match self.descriptor(&dataset, array, expected)? {
            TypeDescriptor::Boolean
            | TypeDescriptor::Enum(_)
            | TypeDescriptor::Integer(_)
            | TypeDescriptor::Unsigned(_) => {}
            other => return Err(self.wrong_type(array, other.to_string(), expected)),
        }
        self.check_shape(&dataset, array, 1)?;
        // Not read as `bool`: a damaged file may hold any byte. HDF5 saturates, so nothing else becomes 0 or 1.
        let values = dataset.read_raw::<i8>().map_err(|source| self.unreadable(array, source))?;
        match values.iter().position(|value| !(0..=1).contains(value)) {
            None => Ok(values.into_iter().map(|value| value == 1).collect()),
            Some(row) => Err(DatasetError::NotBoolean { path: self.path.clone(), array, row, value: values[row] }),
        }
    }

    fn array(&self, array: &'static str) -> Result<hdf5::Dataset, DatasetError> {
        if !self.has(array) {
            return Err(DatasetError::Missing { path: self.path.clone(), array });
        }
        self.file.dataset(array).map_err(|source| self.unreadable(array, source))
    }

    fn descriptor(
        &self,
        dataset: &hdf5::Dataset,
        array: &'static str,
        expected: &'static str,
    ) -> Result<TypeDescriptor, DatasetError> {
        let datatype = dataset.dtype().map_err(|source| self.unreadable(array, source))?;
        // `to_descriptor` reads an enum's member into 8 bytes, whatever size the file gives it.
        if datatype.size() > MAX_FLAG_BYTES {
            return Err(self.wrong_type(array, format!("elements of {} bytes", datatype.size()), expected));
        }
        datatype.to_descriptor().map_err(|error| self.wrong_type(array, error.to_string(), expected))
    }

    fn check_shape(&self, dataset: &hdf5::Dataset, array: &'static str, width: usize) -> Result<(), DatasetError> {
        let found = dataset.shape();
        let matches = found == [self.rows, width] || (width == 1 && found == [self.rows]);
        if !matches {
            let expected = vec![self.rows, width];
            return Err(DatasetError::Shape { path: self.path.clone(), array, found, expected });
        }
        let claimed = (self.rows as u64).saturating_mul(width as u64);
        if claimed > self.bytes.saturating_mul(MAX_COMPRESSION) || self.rows > u32::MAX as usize {
            return Err(DatasetError::Oversized { path: self.path.clone(), array, found, bytes: self.bytes });
        }
        Ok(())
    }

    fn wrong_type(&self, array: &'static str, found: String, expected: &'static str) -> DatasetError {
        DatasetError::Type { path: self.path.clone(), array, found, expected }
    }

    fn unreadable(&self, array: &'static str, source: hdf5::Error) -> DatasetError {
        DatasetError::Unreadable { path: self.path.clone(), array, source }
    }
}
