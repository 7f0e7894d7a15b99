//! HDF5 reader that checks each array for presence, type, shape and size. Damaged HDF5 structures
//! are left to libhdf5, whose version 1.10 crashes on some: open files from trusted sources only.

use std::fs::File;
use std::path::{Path, PathBuf};

use hdf5::dataset::Layout;
use hdf5::types::{FixedAscii, FixedUnicode, TypeDescriptor, VarLenAscii, VarLenUnicode};
use hdf5::{Container, H5Type, IndexType, IterationOrder, LinkType};

use crate::error::{ArrayProblem, DatasetError, Problem};
use crate::formats::array::{Array, check_size};
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
    let version = format!("{major}.{minor}.{release}");
    (version, hdf5::filters::deflate_available())
}

pub(crate) struct Hdf5File {
    path: PathBuf,
    file: hdf5::File,
    bytes: u64,
}

impl Hdf5File {
    pub(crate) fn open(path: &Path) -> Result<Self, DatasetError> {
        Self::checked(path).map_err(|problem| DatasetError::new(path, problem))
    }

    fn checked(path: &Path) -> Result<Self, Problem> {
        let (plain, start) = foreign::start_of(path)?;
        let bytes = plain.metadata()?.len();
        if Format::from_start(&start) != Some(Format::Hdf5) {
            return Err(foreign::from_start(&start));
        }
        let refused = |source| refusal(&plain, &start, bytes, source);
        let file = hdf5::File::open(path).map_err(refused)?;
        let path = path.to_owned();
        Ok(Self { path, file, bytes })
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
    pub(crate) fn names(&self, name: &'static str, count: usize) -> Result<Vec<String>, Problem> {
        let Ok(holder) = self.file.attr(name) else { return Ok(Vec::new()) };
        let texts = texts_in(&holder).unwrap_or_default();
        match texts.len() == count {
            true => Ok(texts),
            false => Err(Problem::Names(name, texts.len(), count)),
        }
    }

    /// Rows and width of an array.
    pub(crate) fn size(&self, array: &str) -> Result<(usize, usize), Problem> {
        let dataset = self.dataset(array);
        let dataset = dataset.map_err(|problem| problem.in_array(array))?;
        let empty = Array::<f32>::new(array, dataset.shape(), Vec::new())?;
        Ok((empty.rows(), empty.width))
    }

    /// Array of numbers, converted to `T`; NaN is allowed.
    pub(crate) fn numbers<T: H5Type>(&self, array: &str) -> Result<Array<T>, Problem> {
        self.read(array, NUMBERS, |dataset, _| Ok(dataset.read_raw()?))
    }

    /// Array of actions, which must be of a floating-point type.
    pub(crate) fn actions(&self, array: &str) -> Result<Array<f32>, Problem> {
        self.read(array, NUMBERS, |dataset, descriptor| match descriptor {
            TypeDescriptor::Float(_) => Ok(dataset.read_raw()?),
            _ => Err(ArrayProblem::DiscreteActions),
        })
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
        let flags = self.read(array, FLAGS, |dataset, descriptor| match descriptor {
            TypeDescriptor::Float(_) => Ok(dataset.read_raw::<f32>()?),
            // A damaged file may hold any byte, which is undefined behavior in a `bool`. HDF5's
            // conversion saturates, so no other value becomes 0 or 1.
            _ => {
                let bytes = dataset.read_raw::<i8>()?;
                Ok(bytes.into_iter().map(f32::from).collect())
            }
        });
        flags?.into_flags(rows)
    }

    /// Array whose type and size are checked before `values` reads it.
    fn read<T>(
        &self,
        array: &str,
        expected: &'static str,
        values: impl Fn(&hdf5::Dataset, TypeDescriptor) -> Result<Vec<T>, ArrayProblem>,
    ) -> Result<Array<T>, Problem> {
        let read = || {
            let dataset = self.dataset(array)?;
            let descriptor = descriptor(&dataset, expected)?;
            let most = self.bytes.saturating_mul(MAX_COMPRESSION);
            check_size(&dataset.shape(), most, self.bytes)?;
            Ok((dataset.shape(), values(&dataset, descriptor)?))
        };
        let (shape, values) = read().map_err(|problem: ArrayProblem| problem.in_array(array))?;
        Array::new(array, shape, values)
    }

    fn dataset(&self, array: &str) -> Result<hdf5::Dataset, ArrayProblem> {
        if !self.has(array) {
            let (group, _) = array.rsplit_once('/').unwrap_or(("/", array));
            let members = self.members(group).unwrap_or_default();
            return Err(ArrayProblem::Missing(members));
        }
        let problem = |source: hdf5::Error| match self.file.group(array) {
            Ok(_) => ArrayProblem::Group,
            Err(_) if self.is_link(array) => ArrayProblem::Elsewhere,
            Err(_) => source.into(),
        };
        let dataset = self.file.dataset(array).map_err(problem)?;
        let creation = dataset.dcpl()?;
        let elsewhere = dataset.filename() != self.file.filename();
        if elsewhere || creation.layout() == Layout::Virtual || !creation.external().is_empty() {
            return Err(ArrayProblem::Elsewhere);
        }
        let filters = creation.filters();
        match filters.iter().find(|filter| !filter.is_available()) {
            Some(filter) => Err(ArrayProblem::Filter(filter_name(filter.id()))),
            None => Ok(dataset),
        }
    }

    /// True for a soft or external link.
    fn is_link(&self, array: &str) -> bool {
        let (group, name) = array.rsplit_once('/').unwrap_or(("/", array));
        let links = |group: hdf5::Group| group.links(IndexType::Name, IterationOrder::Native);
        let links = self.file.group(group).and_then(links).unwrap_or_default();
        let mut links = links.iter().filter(|(link, _)| link == name);
        links.any(|(_, info)| info.link_type != LinkType::Hard)
    }
}

fn descriptor(
    dataset: &hdf5::Dataset,
    expected: &'static str,
) -> Result<TypeDescriptor, ArrayProblem> {
    let wrong = |name: String| ArrayProblem::Type(name, expected);
    let datatype = dataset.dtype()?;
    // `to_descriptor` reads an enum's member into 8 bytes, whatever its size in the file.
    if datatype.size() > MAX_ELEMENT_BYTES {
        return Err(wrong(format!("elements of {} bytes", datatype.size())));
    }
    use TypeDescriptor::{Boolean, Enum, Float, Integer, Unsigned};
    let descriptor = datatype.to_descriptor();
    match descriptor.map_err(|error| wrong(error.to_string()))? {
        number @ (Float(_) | Integer(_) | Unsigned(_)) => Ok(number),
        flag @ (Boolean | Enum(_)) if expected == FLAGS => Ok(flag),
        other => Err(wrong(other.to_string())),
    }
}

fn refusal(file: &File, start: &[u8], bytes: u64, source: hdf5::Error) -> Problem {
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

/// Texts in an attribute or an array, of variable or fixed length, ASCII or UTF-8. Files also hold
/// Latin-1, which `hdf5` would pass on as a `str`.
fn texts_in(holder: &Container) -> Option<Vec<String>> {
    fn as_type<T: H5Type + AsRef<[u8]>>(holder: &Container) -> Option<Vec<String>> {
        let texts = holder.read_raw::<T>().ok()?;
        let text = |text: &T| String::from_utf8_lossy(text.as_ref()).into_owned();
        Some(texts.iter().map(text).collect())
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
