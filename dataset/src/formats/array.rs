//! One array of a dataset file, with checks of its shape.

use crate::error::{ArrayProblem, Problem, RowProblem};

/// N rows of numbers, read from shape N × width, or N if the width is 1. `values` is N × width.
pub(crate) struct Array<T> {
    name: String,
    shape: Vec<usize>,
    pub(crate) width: usize,
    pub(crate) values: Vec<T>,
}

impl<T> Array<T> {
    pub(crate) fn new(name: &str, shape: Vec<usize>, values: Vec<T>) -> Result<Self, Problem> {
        let width = match shape[..] {
            [_] => 1,
            [_, width] if width > 0 => width,
            _ => return Err(ArrayProblem::Axes(shape).in_array(name)),
        };
        let name = name.to_owned();
        Ok(Self { name, shape, width, values })
    }

    pub(crate) fn rows(&self) -> usize {
        self.shape[0]
    }

    pub(crate) fn row(&self, row: usize) -> &[T] {
        &self.values[row * self.width..(row + 1) * self.width]
    }

    pub(crate) fn with_rows(self, rows: usize) -> Result<Self, Problem> {
        match self.rows() == rows {
            true => Ok(self),
            false => Err(ArrayProblem::Rows(self.shape, rows).in_array(&self.name)),
        }
    }

    pub(crate) fn sized(self, rows: usize, width: usize) -> Result<Vec<T>, Problem> {
        match (self.rows(), self.width) == (rows, width) {
            true => Ok(self.values),
            false => Err(ArrayProblem::Shape(self.shape, [rows, width]).in_array(&self.name)),
        }
    }
}

impl Array<f32> {
    /// One flag per row; all values must be 0 or 1.
    pub(crate) fn into_flags(self, rows: usize) -> Result<Vec<bool>, Problem> {
        let array = self.name.clone();
        let values = self.sized(rows, 1)?;
        let is_other = |value: &f32| *value != 0.0 && *value != 1.0;
        match values.iter().position(is_other) {
            None => Ok(values.into_iter().map(|value| value == 1.0).collect()),
            Some(row) => Err(RowProblem::NotBoolean(values[row]).in_row(&array, row)),
        }
    }
}

/// Refuses a shape of more numbers than `most`, or of more rows than indices, in a file of `bytes`.
pub(crate) fn check_size(shape: &[usize], most: u64, bytes: u64) -> Result<(), ArrayProblem> {
    let axes = shape.iter().map(|axis| *axis as u64);
    let claimed = axes.fold(1, u64::saturating_mul);
    match claimed > most || shape.first().is_some_and(|&rows| rows > u32::MAX as usize) {
        true => Err(ArrayProblem::Oversized(shape.to_vec(), bytes)),
        false => Ok(()),
    }
}
