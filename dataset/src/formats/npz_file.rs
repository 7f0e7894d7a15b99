use std::fs::File;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};

use npyz::half::f16;
use npyz::{DType, Deserialize, NpyFile, Order, TypeChar};
use zip::ZipArchive;
use zip::result::ZipError;

use crate::error::{DatasetError, Problem};
use crate::formats::array::Array;
use crate::formats::foreign;

pub(crate) struct NpzFile {
    path: PathBuf,
    archive: ZipArchive<BufReader<File>>,
}

impl NpzFile {
    pub(crate) fn open(path: &Path) -> Result<Self, DatasetError> {
        let file =
            File::open(path).map_err(|source| DatasetError::new(path, Problem::Io(source)))?;
        let archive = ZipArchive::new(BufReader::new(file))
            .map_err(|source| DatasetError::new(path, Problem::DamagedNpz(source)))?;
        if let Some(problem) =
            foreign::of_archive(&archive.file_names().filter_map(Result::ok).collect::<Vec<_>>())
        {
            return Err(DatasetError::new(path, problem));
        }
        Ok(Self { path: path.into(), archive })
    }

    pub(crate) fn has(&self, array: &str) -> bool {
        self.archive.index_for_name(&entry(array)).is_some()
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Array of numbers, converted to float32; NaN is allowed.
    pub(crate) fn numbers(&mut self, array: &str) -> Result<Array<f32>, Problem> {
        self.read(array, false)
    }

    /// Array of actions, which must be of a floating-point type.
    pub(crate) fn actions(&mut self, array: &str) -> Result<Array<f32>, Problem> {
        self.read(array, true)
    }

    pub(crate) fn table(
        &mut self,
        array: &str,
        rows: usize,
        width: usize,
    ) -> Result<Vec<f32>, Problem> {
        self.numbers(array)?.sized(rows, width)
    }

    pub(crate) fn flags(&mut self, array: &str, rows: usize) -> Result<Vec<bool>, Problem> {
        self.numbers(array)?.into_flags(rows)
    }

    fn read(&mut self, array: &str, continuous: bool) -> Result<Array<f32>, Problem> {
        let name = array.to_owned();
        let entry = self.archive.by_name(&entry(array)).map_err(|error| match error {
            ZipError::FileNotFound => Problem::Missing { array: name.clone() },
            other => Problem::DamagedNpz(other),
        })?;
        let bytes = entry.size();
        let unreadable =
            |source: io::Error| Problem::Unreadable { array: name.clone(), source: source.into() };
        let mut reader = BufReader::new(entry);
        let file = NpyFile::new(&mut reader).map_err(unreadable)?;
        if continuous && holds_whole_numbers(&file.dtype()) {
            return Err(Problem::DiscreteActions { array: name });
        }
        let shape: Vec<usize> = file.shape().iter().map(|&axis| axis as usize).collect();
        let claimed = shape.iter().fold(1u64, |product, &axis| product.saturating_mul(axis as u64));
        if claimed > bytes || shape.first().is_some_and(|&rows| rows > u32::MAX as usize) {
            return Err(Problem::Oversized { array: name, found: shape, bytes });
        }
        let order = file.order();
        let values = floats(file, &name)?;
        // The checksum is compared at the end of the entry.
        io::copy(&mut reader, &mut io::sink()).map_err(unreadable)?;
        Array::new(
            array,
            &shape,
            if order == Order::Fortran { by_rows(&shape, &values) } else { values },
        )
    }
}

fn entry(array: &str) -> String {
    format!("{array}.npy")
}

fn holds_whole_numbers(dtype: &DType) -> bool {
    let DType::Plain(element) = dtype else { return false };
    matches!(element.type_char(), TypeChar::Bool | TypeChar::Int | TypeChar::Uint)
}

fn floats<R: io::Read>(file: NpyFile<R>, array: &str) -> Result<Vec<f32>, Problem> {
    let DType::Plain(element) = file.dtype() else {
        return Err(wrong_type(array, file.dtype().descr()));
    };
    match (element.type_char(), element.size_field()) {
        (TypeChar::Float, 2) => convert::<f16, R>(file, array, f32::from),
        (TypeChar::Float, 4) => convert::<f32, R>(file, array, |value| value),
        (TypeChar::Float, 8) => convert::<f64, R>(file, array, |value| value as f32),
        (TypeChar::Bool, 1) => convert::<bool, R>(file, array, |value| f32::from(u8::from(value))),
        (TypeChar::Int, 1) => convert::<i8, R>(file, array, f32::from),
        (TypeChar::Int, 2) => convert::<i16, R>(file, array, f32::from),
        (TypeChar::Int, 4) => convert::<i32, R>(file, array, |value| value as f32),
        (TypeChar::Int, 8) => convert::<i64, R>(file, array, |value| value as f32),
        (TypeChar::Uint, 1) => convert::<u8, R>(file, array, f32::from),
        (TypeChar::Uint, 2) => convert::<u16, R>(file, array, f32::from),
        (TypeChar::Uint, 4) => convert::<u32, R>(file, array, |value| value as f32),
        (TypeChar::Uint, 8) => convert::<u64, R>(file, array, |value| value as f32),
        _ => Err(wrong_type(array, element.to_string())),
    }
}

fn convert<T: Deserialize, R: io::Read>(
    file: NpyFile<R>,
    array: &str,
    to_f32: impl Fn(T) -> f32,
) -> Result<Vec<f32>, Problem> {
    let found = file.dtype().descr();
    let values = file.data::<T>().map_err(|_| wrong_type(array, found))?;
    let values: io::Result<Vec<f32>> = values.map(|value| value.map(&to_f32)).collect();
    values.map_err(|source| Problem::Unreadable { array: array.to_owned(), source: source.into() })
}

fn wrong_type(array: &str, found: String) -> Problem {
    Problem::Type { array: array.to_owned(), found, expected: "numbers or booleans" }
}

/// Row-major copy of a column-major array.
fn by_rows(shape: &[usize], values: &[f32]) -> Vec<f32> {
    let rows = shape.first().copied().unwrap_or(0);
    (0..rows).flat_map(|row| values.iter().skip(row).step_by(rows.max(1)).copied()).collect()
}
