//! HDF5 reader that checks each array for presence, type, shape and size. Damaged HDF5 structures
//! are left to libhdf5, whose version 1.10 crashes on some: open files from trusted sources only.

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

/// Deflate compresses at most 1032-fold; a larger ratio means a false array size.
const MAX_COMPRESSION: u64 = 1040;

/// Size of the largest numbers, and of the largest integer that HDF5's tools use for an enum.
const MAX_ELEMENT_BYTES: usize = 8;

const MAX_TEXT: usize = 256;

const NUMBERS: &str = "numbers";
const FLAGS: &str = "booleans (h5py's enum, or numbers that are 0 or 1)";

/// Version of the linked HDF5 library, and true if it reads compressed arrays such as D4RL's.
pub fn hdf5_library() -> (String, bool) {
    let (major, minor, release) = hdf5::library_version();
    (format!("{major}.{minor}.{release}"), hdf5::filters::deflate_available())
}

pub(crate) struct Hdf5File {
    path: PathBuf,
    file: hdf5::File,
    bytes: u64,
}

impl Hdf5File {
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

    pub(crate) fn has(&self, name: &str) -> bool {
        match name.rsplit_once('/') {
            Some((group, _)) if !self.has(group) => false,
            _ => self.file.link_exists(name),
        }
    }

    /// Names of a group's members in alphabetical order; `None` if it is not a group.
    pub(crate) fn members(&self, group: &str) -> Option<Vec<String>> {
        let mut names = self.file.group(group).ok()?.member_names().ok()?;
        names.sort_unstable();
        Some(names)
    }

    pub(crate) fn text(&self, array: &str) -> Option<String> {
        text_in(&*self.dataset(array).ok()?)
    }

    pub(crate) fn attribute(&self, name: &str) -> Option<String> {
        Some(text_in(&*self.file.attr(name).ok()?).unwrap_or_default())
    }

    /// Root attribute of `count` texts; empty if absent.
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

    pub(crate) fn size(&self, array: &str) -> Result<(usize, usize), Problem> {
        let empty = Array::<f32>::new(array, &self.dataset(array)?.shape(), Vec::new())?;
        Ok((empty.rows(), empty.width))
    }

    /// Array of numbers, converted to `T`; NaN is allowed.
    pub(crate) fn numbers<T: H5Type>(&self, array: &str) -> Result<Array<T>, Problem> {
        let dataset = self.dataset(array)?;
        self.descriptor(&dataset, array, NUMBERS)?;
        let shape = self.check_size(&dataset, array)?;
        let values = dataset.read_raw::<T>().map_err(|source| unreadable(array, source))?;
        Array::new(array, &shape, values)
    }

    /// Array of actions, which must be of a floating-point type.
    pub(crate) fn actions(&self, array: &str) -> Result<Array<f32>, Problem> {
        match self.descriptor(&self.dataset(array)?, array, NUMBERS)? {
            TypeDescriptor::Float(_) => self.numbers(array),
            _ => Err(Problem::DiscreteActions { array: array.to_owned() }),
        }
    }

    pub(crate) fn table<T: H5Type>(
        &self,
        array: &str,
        rows: usize,
        width: usize,
    ) -> Result<Vec<T>, Problem> {
        self.numbers(array)?.sized(rows, width)
    }

    pub(crate) fn flags(&self, array: &str, rows: usize) -> Result<Vec<bool>, Problem> {
        let dataset = self.dataset(array)?;
        let descriptor = self.descriptor(&dataset, array, FLAGS)?;
        let shape = self.check_size(&dataset, array)?;
        let values = match descriptor {
            TypeDescriptor::Float(_) => dataset.read_raw::<f32>(),
            // A damaged file may hold any byte, which is undefined behavior in a `bool`. HDF5's
            // conversion saturates, so no other value becomes 0 or 1.
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

    /// True for a soft or external link.
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
        // `to_descriptor` reads an enum's member into 8 bytes, whatever its size in the file.
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

fn refusal(file: &File, start: &[u8], bytes: u64, source: hdf5::Error) -> Problem {
    if Format::of(start) != Some(Format::Hdf5) {
        return foreign::of_start(start);
    }
    if file.try_lock_shared().is_err() {
        return Problem::Locked(source);
    }
    match end_of_file(start) {
        Some(expected) if expected > bytes => Problem::Truncated { bytes, expected },
        // Bit 0 of the consistency flags, byte 11 in version 3 of the superblock.
        Some(_) if start[8] == 3 && start[11] & 1 == 1 => Problem::NotClosed(source),
        _ => Problem::DamagedHdf5(source),
    }
}

/// Name of a filter by its number in HDF5's registry.
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

fn text_in(holder: &Container) -> Option<String> {
    let mut texts = texts_in(holder)?;
    if texts.len() == 1 { texts.pop() } else { None }
}

/// Texts in an attribute or an array, of variable or fixed length, ASCII or UTF-8.
fn texts_in(holder: &Container) -> Option<Vec<String>> {
    fn as_type<T: H5Type + Display>(holder: &Container) -> Option<Vec<String>> {
        Some(holder.read_raw::<T>().ok()?.iter().map(T::to_string).collect())
    }
    as_type::<VarLenUnicode>(holder)
        .or_else(|| as_type::<VarLenAscii>(holder))
        .or_else(|| as_type::<FixedUnicode<MAX_TEXT>>(holder))
        .or_else(|| as_type::<FixedAscii<MAX_TEXT>>(holder))
}

/// File size by a superblock with 8-byte addresses (HDF5 File Format Specification 3.0, II.A).
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
