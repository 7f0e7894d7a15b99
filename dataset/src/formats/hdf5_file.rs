//! Arrays of an HDF5 file, each checked for presence, type, shape and size before it is used.
//!
//! Damage to HDF5's own structures is libhdf5's to find, and its 1.10 does not survive all of it: a
//! dataset is to come from a place that is trusted.

use std::fmt::Display;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use hdf5::dataset::Layout;
use hdf5::types::{FixedAscii, FixedUnicode, TypeDescriptor, VarLenAscii, VarLenUnicode};
use hdf5::{Container, H5Type, IndexType, IterationOrder, LinkType};

use crate::error::{DatasetError, Problem};
use crate::formats::array::Array;
use crate::formats::foreign;
use crate::tables::benchmarks::Format;

/// deflate shrinks by a factor of 1032 at most, so more than that in an array is a lie about its
/// size.
const MAX_COMPRESSION: u64 = 1040;

/// The largest number that is read, and the largest integer type that HDF5's own tools use for an
/// enum.
const MAX_ELEMENT_BYTES: usize = 8;

/// The longest text of fixed length that is read whole.
const MAX_TEXT: usize = 256;

const NUMBERS: &str = "numbers";
const FLAGS: &str = "booleans (h5py's enum, or numbers that are 0 or 1)";

/// Version of the HDF5 library that this program found, and whether it reads compressed arrays, as
/// D4RL's are.
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
        let plain = File::open(path).map_err(io_error)?;
        let bytes = plain.metadata().map_err(io_error)?.len();
        (&plain).take(foreign::START).read_to_end(&mut start).map_err(io_error)?;
        let refused = |source| DatasetError::new(path, refusal(&plain, &start, bytes, source));
        let file = hdf5::File::open(path).map_err(refused)?;
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
        text_in(&*self.dataset(array).ok()?)
    }

    /// A text that the file's root has as an attribute; empty where the attribute is something
    /// else.
    pub(crate) fn attribute(&self, name: &str) -> Option<String> {
        Some(text_in(&*self.file.attr(name).ok()?).unwrap_or_default())
    }

    /// A list of `count` texts that the file's root has as an attribute; empty where it has none.
    pub(crate) fn names(&self, attribute: &str, count: usize) -> Result<Vec<String>, Problem> {
        let Ok(holder) = self.file.attr(attribute) else { return Ok(Vec::new()) };
        match texts_in(&holder).unwrap_or_default() {
            texts if texts.len() == count => Ok(texts),
            texts => Err(Problem::Names {
                attribute: attribute.to_owned(),
                found: texts.len(),
                expected: count,
            }),
        }
    }

    /// Rows of an array, and numbers in each.
    pub(crate) fn size(&self, array: &str) -> Result<(usize, usize), Problem> {
        let empty = Array::<f32>::new(array, &self.dataset(array)?.shape(), Vec::new())?;
        Ok((empty.rows(), empty.width))
    }

    /// An array of numbers, converted to `T`, that may be NaN.
    pub(crate) fn numbers<T: H5Type>(&self, array: &str) -> Result<Array<T>, Problem> {
        let dataset = self.dataset(array)?;
        self.descriptor(&dataset, array, NUMBERS)?;
        let shape = self.check_size(&dataset, array)?;
        let values = dataset.read_raw::<T>().map_err(|source| unreadable(array, source))?;
        Array::new(array, &shape, values)
    }

    /// An array of actions: numbers whose type says that they are continuous.
    pub(crate) fn actions(&self, array: &str) -> Result<Array<f32>, Problem> {
        match self.descriptor(&self.dataset(array)?, array, NUMBERS)? {
            TypeDescriptor::Float(_) => self.numbers(array),
            _ => Err(Problem::DiscreteActions { array: array.to_owned() }),
        }
    }

    /// An array of `rows × width` numbers.
    pub(crate) fn table<T: H5Type>(
        &self,
        array: &str,
        rows: usize,
        width: usize,
    ) -> Result<Vec<T>, Problem> {
        self.numbers(array)?.sized(rows, width)
    }

    /// An array of one flag a row.
    pub(crate) fn flags(&self, array: &str, rows: usize) -> Result<Vec<bool>, Problem> {
        let dataset = self.dataset(array)?;
        let descriptor = self.descriptor(&dataset, array, FLAGS)?;
        let shape = self.check_size(&dataset, array)?;
        let values = match descriptor {
            TypeDescriptor::Float(_) => dataset.read_raw::<f32>(),
            // Not read as `bool`: a damaged file may hold any byte. HDF5 saturates, so nothing else
            // becomes 0 or 1.
            _ => dataset.read_raw::<i8>().map(|values| values.into_iter().map(f32::from).collect()),
        };
        let values = values.map_err(|source| unreadable(array, source))?;
        Array::new(array, &shape, values).and_then(|array| array.into_flags(rows))
    }

    fn dataset(&self, array: &str) -> Result<hdf5::Dataset, Problem> {
        if !self.has(array) {
            return Err(Problem::Missing { array: array.to_owned() });
        }
        let name = || array.to_owned();
        let dataset = self.file.dataset(array).map_err(|source| match self.file.group(array) {
            Ok(_) => Problem::Group { array: name() },
            Err(_) if self.is_link(array) => Problem::Elsewhere { array: name() },
            Err(_) => unreadable(array, source),
        })?;
        let creation = dataset.dcpl().map_err(|source| unreadable(array, source))?;
        let elsewhere = dataset.filename() != self.file.filename();
        if elsewhere || creation.layout() == Layout::Virtual || !creation.external().is_empty() {
            return Err(Problem::Elsewhere { array: name() });
        }
        match creation.filters().iter().find(|filter| !filter.is_available()) {
            Some(filter) => {
                Err(Problem::Filter { array: name(), filter: filter_name(filter.id()) })
            }
            None => Ok(dataset),
        }
    }

    /// Whether an array's name leads to an array elsewhere, in this file or in another one.
    fn is_link(&self, array: &str) -> bool {
        let (group, name) = array.rsplit_once('/').unwrap_or(("/", array));
        let links = self
            .file
            .group(group)
            .and_then(|group| group.links(IndexType::Name, IterationOrder::Native));
        links
            .unwrap_or_default()
            .iter()
            .any(|(link, info)| link == name && info.link_type != LinkType::Hard)
    }

    fn descriptor(
        &self,
        dataset: &hdf5::Dataset,
        array: &str,
        expected: &'static str,
    ) -> Result<TypeDescriptor, Problem> {
        let wrong = |found: String| Problem::Type { array: array.to_owned(), found, expected };
        let datatype = dataset.dtype().map_err(|source| unreadable(array, source))?;
        // `to_descriptor` reads an enum's member into 8 bytes, whatever size the file gives it.
        if datatype.size() > MAX_ELEMENT_BYTES {
            return Err(wrong(format!("elements of {} bytes", datatype.size())));
        }
        let descriptor = datatype.to_descriptor().map_err(|error| wrong(error.to_string()))?;
        match descriptor {
            TypeDescriptor::Float(_) | TypeDescriptor::Integer(_) | TypeDescriptor::Unsigned(_) => {
                Ok(descriptor)
            }
            TypeDescriptor::Boolean | TypeDescriptor::Enum(_) if expected == FLAGS => {
                Ok(descriptor)
            }
            other => Err(wrong(other.to_string())),
        }
    }

    fn check_size(&self, dataset: &hdf5::Dataset, array: &str) -> Result<Vec<usize>, Problem> {
        let shape = dataset.shape();
        let claimed = shape.iter().fold(1u64, |product, &axis| product.saturating_mul(axis as u64));
        let rows = shape.first().copied().unwrap_or(0);
        if claimed > self.bytes.saturating_mul(MAX_COMPRESSION) || rows > u32::MAX as usize {
            let array = array.to_owned();
            return Err(Problem::Oversized { array, found: shape, bytes: self.bytes });
        }
        Ok(shape)
    }
}

fn unreadable(array: &str, source: hdf5::Error) -> Problem {
    Problem::Unreadable { array: array.to_owned(), source: source.into() }
}

/// Why HDF5 refuses a file of `bytes` bytes that begins like this.
fn refusal(file: &File, start: &[u8], bytes: u64, source: hdf5::Error) -> Problem {
    if Format::of(start) != Some(Format::Hdf5) {
        return foreign::of_start(start);
    }
    if file.try_lock_shared().is_err() {
        return Problem::Locked(source);
    }
    match end_of_file(start) {
        Some(expected) if expected > bytes => Problem::Truncated { bytes, expected },
        // Bit 0 of the consistency flags, which version 3 of the superblock has in byte 11.
        Some(_) if start[8] == 3 && start[11] & 1 == 1 => Problem::NotClosed(source),
        _ => Problem::DamagedHdf5(source),
    }
}

/// What people call a filter, by its number in HDF5's registry.
fn filter_name(id: i32) -> String {
    let name = match id {
        1 => "gzip",
        4 => "szip",
        32001 => "blosc",
        32004 => "lz4",
        32008 => "bitshuffle",
        32013 => "zfp",
        32015 => "zstd",
        32026 => "blosc2",
        _ => return format!("number {id}"),
    };
    name.to_owned()
}

/// The one text that an attribute or an array holds.
fn text_in(holder: &Container) -> Option<String> {
    let mut texts = texts_in(holder)?;
    if texts.len() == 1 { texts.pop() } else { None }
}

/// The texts that an attribute or an array holds, as HDF5's programs write them: of variable or
/// fixed length, ASCII or UTF-8.
fn texts_in(holder: &Container) -> Option<Vec<String>> {
    fn as_type<T: H5Type + Display>(holder: &Container) -> Option<Vec<String>> {
        Some(holder.read_raw::<T>().ok()?.iter().map(T::to_string).collect())
    }
    as_type::<VarLenUnicode>(holder)
        .or_else(|| as_type::<VarLenAscii>(holder))
        .or_else(|| as_type::<FixedUnicode<MAX_TEXT>>(holder))
        .or_else(|| as_type::<FixedAscii<MAX_TEXT>>(holder))
}

/// The length that the file's superblock says the file has, of any of its versions with 8-byte
/// addresses.
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
