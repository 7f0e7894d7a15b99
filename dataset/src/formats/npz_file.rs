//! Reader of NumPy's npz archives that checks each array for presence, type, shape and size.

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};

use npyz::half::f16;
use npyz::{DType, Deserialize, NpyFile, Order, TypeChar};
use zip::ZipArchive;

use crate::error::{ArrayProblem, DatasetError, Problem};
use crate::formats::array::{Array, check_size};
use crate::formats::foreign;

pub(crate) struct NpzFile {
    path: PathBuf,
    archive: ZipArchive<BufReader<File>>,
}

impl NpzFile {
    pub(crate) fn open(path: &Path) -> Result<Self, DatasetError> {
        let error = |problem| DatasetError::new(path, problem);
        let file = File::open(path).map_err(|source| error(source.into()))?;
        let archive =
            ZipArchive::new(BufReader::new(file)).map_err(|source| error(source.into()))?;
        let path = path.to_owned();
        let files = Vec::from_iter(archive.file_names().filter_map(Result::ok));
        match foreign::from_archive(&files) {
            Some(problem) => Err(error(problem)),
            None => Ok(Self { path, archive }),
        }
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

    fn read(&mut self, array: &str, continuous: bool) -> Result<Array<f32>, Problem> {
        if !self.has(array) {
            let names = self.archive.file_names().filter_map(Result::ok);
            let there = names.filter_map(|name| Some(name.strip_suffix(".npy")?.to_owned()));
            return Err(ArrayProblem::Missing(there.collect()).in_array(array));
        }
        let entry = self.archive.by_name(&entry(array))?;
        let (shape, values) =
            values(entry.size(), entry, continuous).map_err(|problem| problem.in_array(array))?;
        Array::new(array, shape, values)
    }
}

/// Shape and values, in row-major order, of a NumPy file of `bytes`.
fn values(
    bytes: u64,
    entry: impl Read,
    continuous: bool,
) -> Result<(Vec<usize>, Vec<f32>), ArrayProblem> {
    let mut reader = BufReader::new(entry);
    let file = NpyFile::new(&mut reader)?;
    if continuous && holds_whole_numbers(&file.dtype()) {
        return Err(ArrayProblem::DiscreteActions);
    }
    let shape: Vec<usize> = file.shape().iter().map(|&axis| axis as usize).collect();
    check_size(&shape, bytes, bytes)?;
    let is_by_columns = file.order() == Order::Fortran;
    let values = floats(file)?;
    // The checksum is compared at the end of the entry.
    io::copy(&mut reader, &mut io::sink())?;
    match is_by_columns {
        true => Ok((shape.clone(), by_rows(&shape, &values))),
        false => Ok((shape, values)),
    }
}

fn entry(array: &str) -> String {
    format!("{array}.npy")
}

fn holds_whole_numbers(dtype: &DType) -> bool {
    use TypeChar::{Bool, Int, Uint};
    let DType::Plain(element) = dtype else { return false };
    matches!(element.type_char(), Bool | Int | Uint)
}

fn floats(file: NpyFile<impl Read>) -> Result<Vec<f32>, ArrayProblem> {
    let DType::Plain(element) = file.dtype() else { return Err(wrong_type(&file.dtype())) };
    match (element.type_char(), element.size_field()) {
        (TypeChar::Float, 2) => convert(file, f16::to_f32),
        (TypeChar::Float, 4) => convert(file, |value: f32| value),
        (TypeChar::Float, 8) => convert(file, |value: f64| value as f32),
        (TypeChar::Bool, 1) => convert(file, |value: bool| f32::from(u8::from(value))),
        (TypeChar::Int, 1) => convert(file, |value: i8| value as f32),
        (TypeChar::Int, 2) => convert(file, |value: i16| value as f32),
        (TypeChar::Int, 4) => convert(file, |value: i32| value as f32),
        (TypeChar::Int, 8) => convert(file, |value: i64| value as f32),
        (TypeChar::Uint, 1) => convert(file, |value: u8| value as f32),
        (TypeChar::Uint, 2) => convert(file, |value: u16| value as f32),
        (TypeChar::Uint, 4) => convert(file, |value: u32| value as f32),
        (TypeChar::Uint, 8) => convert(file, |value: u64| value as f32),
        _ => Err(wrong_type(&file.dtype())),
    }
}

fn convert<T: Deserialize>(
    file: NpyFile<impl Read>,
    to_f32: impl Fn(T) -> f32,
) -> Result<Vec<f32>, ArrayProblem> {
    let dtype = file.dtype();
    let values = file.data::<T>().map_err(|_| wrong_type(&dtype))?;
    let values = values.map(|value| value.map(&to_f32));
    Ok(values.collect::<io::Result<_>>()?)
}

fn wrong_type(dtype: &DType) -> ArrayProblem {
    ArrayProblem::Type(dtype.descr(), "numbers or booleans")
}

/// Row-major copy of a column-major array.
fn by_rows(shape: &[usize], values: &[f32]) -> Vec<f32> {
    let rows = shape.first().copied().unwrap_or(0);
    let row = |row| values.iter().skip(row).step_by(rows.max(1));
    (0..rows).flat_map(row).copied().collect()
}
