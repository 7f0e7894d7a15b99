//! Arrays of an HDF5 file, each checked for presence, type, shape and size before it is used.
//!
//! Damage to HDF5's own structures is libhdf5's to find, and its 1.10 does not survive all of it: a dataset is to come
//! from a place that is trusted.

use std::fmt::Display;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use hdf5::types::{FixedAscii, FixedUnicode, TypeDescriptor, VarLenAscii, VarLenUnicode};
use hdf5::{Container, H5Type};

use crate::array::Array;
use crate::error::{DatasetError, Problem};

/// The first bytes of an HDF5 file.
pub const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";

/// deflate shrinks by a factor of 1032 at most, so more than that in an array is a lie about its size.
const MAX_COMPRESSION: u64 = 1040;

/// The largest number that is read, and the largest integer type that HDF5's own tools use for an enum.
const MAX_ELEMENT_BYTES: usize = 8;

/// The longest text of fixed length that is read whole.
const MAX_TEXT: usize = 256;

const NUMBERS: &str = "numbers";
const FLAGS: &str = "booleans (h5py's enum, or numbers that are 0 or 1)";

/// Version of the HDF5 library that this program found, and whether it reads compressed arrays, as D4RL's are.
pub fn hdf5_library() -> (String, bool) {
    let (major, minor, release) = hdf5::library_version();
    (format!("{major}.{minor}.{release}"), hdf5::filters::deflate_available())
}

/// An open HDF5 file.
pub(crate) struct Hdf5File {
    path: PathBuf,
    file: hdf5::File,
    bytes: u64,
}

impl Hdf5File {
    /// Opens a file.
    pub(crate) fn open(path: &Path) -> Result<Self, DatasetError> {
        let io_error = |source| DatasetError::new(path, Problem::Io(source));
        let mut start = Vec::new();
        let file = File::open(path).map_err(io_error)?;
        let bytes = file.metadata().map_err(io_error)?.len();
        file.take(64).read_to_end(&mut start).map_err(io_error)?;
        let file = hdf5::File::open(path).map_err(|source| {
            let problem = match end_of_file(&start) {
                Some(expected) if expected > bytes => Problem::Truncated { bytes, expected },
                _ => Problem::DamagedHdf5(source),
            };
            DatasetError::new(path, problem)
        })?;
        Ok(Self { path: path.into(), file, bytes })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Whether there is an array or a group of that name.
    pub(crate) fn has(&self, name: &str) -> bool {
        match name.rsplit_once('/') {
            Some((group, _)) if !self.has(group) => false,
            _ => self.file.link_exists(name),
        }
    }

    /// Names of what a group holds, in alphabetical order; none if it is no group.
    pub(crate) fn members(&self, group: &str) -> Option<Vec<String>> {
        let mut names = self.file.group(group).ok()?.member_names().ok()?;
        names.sort_unstable();
        Some(names)
    }

    /// A text that stands in the file as an array of its own.
    pub(crate) fn text(&self, array: &str) -> Option<String> {
        text_in(&*self.file.dataset(array).ok()?)
    }

    /// A text that the file's root has as an attribute; empty where the attribute is something else.
    pub(crate) fn attribute(&self, name: &str) -> Option<String> {
        Some(text_in(&*self.file.attr(name).ok()?).unwrap_or_default())
    }

    /// Rows of an array, and numbers in each.
    pub(crate) fn size(&self, array: &str) -> Result<(usize, usize), DatasetError> {
        let empty = Array::<f32>::new(array, &self.dataset(array)?.shape(), Vec::new());
        empty.map(|array| (array.rows(), array.width)).map_err(|problem| self.error(problem))
    }

    /// An array of numbers, converted to `T`, that may be NaN.
    pub(crate) fn numbers<T: H5Type>(&self, array: &str) -> Result<Array<T>, DatasetError> {
        let dataset = self.dataset(array)?;
        self.descriptor(&dataset, array, NUMBERS)?;
        let shape = self.check_size(&dataset, array)?;
        let values = dataset.read_raw::<T>().map_err(|source| self.unreadable(array, source))?;
        Array::new(array, &shape, values).map_err(|problem| self.error(problem))
    }

    /// An array of actions: numbers whose type says that they are continuous.
    pub(crate) fn actions(&self, array: &str) -> Result<Array<f32>, DatasetError> {
        match self.descriptor(&self.dataset(array)?, array, NUMBERS)? {
            TypeDescriptor::Float(_) => self.numbers(array),
            _ => Err(self.error(Problem::DiscreteActions { array: array.to_owned() })),
        }
    }

    /// An array of `rows × width` numbers.
    pub(crate) fn table<T: H5Type>(&self, array: &str, rows: usize, width: usize) -> Result<Vec<T>, DatasetError> {
        self.numbers(array)?.sized(rows, width).map_err(|problem| self.error(problem))
    }

    /// An array of one flag a row.
    pub(crate) fn flags(&self, array: &str, rows: usize) -> Result<Vec<bool>, DatasetError> {
        let dataset = self.dataset(array)?;
        let descriptor = self.descriptor(&dataset, array, FLAGS)?;
        let shape = self.check_size(&dataset, array)?;
        let values = match descriptor {
            TypeDescriptor::Float(_) => dataset.read_raw::<f32>(),
            // Not read as `bool`: a damaged file may hold any byte. HDF5 saturates, so nothing else becomes 0 or 1.
            _ => dataset.read_raw::<i8>().map(|values| values.into_iter().map(f32::from).collect()),
        };
        let values = values.map_err(|source| self.unreadable(array, source))?;
        Array::new(array, &shape, values)
            .and_then(|array| array.into_flags(rows))
            .map_err(|problem| self.error(problem))
    }

    pub(crate) fn error(&self, problem: Problem) -> DatasetError {
        DatasetError::new(&self.path, problem)
    }

    fn dataset(&self, array: &str) -> Result<hdf5::Dataset, DatasetError> {
        if !self.has(array) {
            return Err(self.error(Problem::Missing { array: array.to_owned() }));
        }
        self.file.dataset(array).map_err(|source| match self.file.group(array) {
            Ok(_) => self.error(Problem::Group { array: array.to_owned() }),
            Err(_) => self.unreadable(array, source),
        })
    }

    fn descriptor(
        &self,
        dataset: &hdf5::Dataset,
        array: &str,
        expected: &'static str,
    ) -> Result<TypeDescriptor, DatasetError> {
        let wrong = |found: String| self.error(Problem::Type { array: array.to_owned(), found, expected });
        let datatype = dataset.dtype().map_err(|source| self.unreadable(array, source))?;
        // `to_descriptor` reads an enum's member into 8 bytes, whatever size the file gives it.
        if datatype.size() > MAX_ELEMENT_BYTES {
            return Err(wrong(format!("elements of {} bytes", datatype.size())));
        }
        let descriptor = datatype.to_descriptor().map_err(|error| wrong(error.to_string()))?;
        match descriptor {
            TypeDescriptor::Float(_) | TypeDescriptor::Integer(_) | TypeDescriptor::Unsigned(_) => Ok(descriptor),
            TypeDescriptor::Boolean | TypeDescriptor::Enum(_) if expected == FLAGS => Ok(descriptor),
            other => Err(wrong(other.to_string())),
        }
    }

    fn check_size(&self, dataset: &hdf5::Dataset, array: &str) -> Result<Vec<usize>, DatasetError> {
        let shape = dataset.shape();
        let claimed = shape.iter().fold(1u64, |product, &axis| product.saturating_mul(axis as u64));
        let rows = shape.first().copied().unwrap_or(0);
        if claimed > self.bytes.saturating_mul(MAX_COMPRESSION) || rows > u32::MAX as usize {
            let array = array.to_owned();
            return Err(self.error(Problem::Oversized { array, found: shape, bytes: self.bytes }));
        }
        Ok(shape)
    }

    fn unreadable(&self, array: &str, source: hdf5::Error) -> DatasetError {
        self.error(Problem::UnreadableHdf5 { array: array.to_owned(), source })
    }
}

/// The text that an attribute or an array holds, as HDF5's programs write one: of variable or fixed length, ASCII or UTF-8.
fn text_in(holder: &Container) -> Option<String> {
    fn as_type<T: H5Type + Display>(holder: &Container) -> Option<String> {
        let texts = holder.read_raw::<T>().ok()?;
        (texts.len() == 1).then(|| texts[0].to_string())
    }
    as_type::<VarLenUnicode>(holder)
        .or_else(|| as_type::<VarLenAscii>(holder))
        .or_else(|| as_type::<FixedUnicode<MAX_TEXT>>(holder))
        .or_else(|| as_type::<FixedAscii<MAX_TEXT>>(holder))
}

/// The length that the file's superblock says the file has, of any of its versions with 8-byte addresses.
///
/// HDF5 File Format Specification 3.0, II.A.
fn end_of_file(start: &[u8]) -> Option<u64> {
    let address = match (start.get(8)?, start.get(9)?, start.get(13)?) {
        (0, _, 8) => 40,
        (1, _, 8) => 44,
        (2 | 3, 8, _) => 28,
        _ => return None,
    };
    let bytes = start.get(address..address + 8)?;
    Some(u64::from_le_bytes(bytes.try_into().ok()?))
}
