//! Arrays from Python as rows of numbers, and back.

use numpy::{AllowTypeChange, Element, PyArray, PyArrayDyn, PyArrayLikeDyn, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use std::borrow::Cow;

/// What Python gives for an array: float32 as it is, anything else that NumPy takes, converted.
pub struct Like<'py> {
    array: PyArrayLikeDyn<'py, f32, AllowTypeChange>,
    /// The names that a table, such as pandas's, has for its columns.
    columns: Vec<String>,
}

impl<'a, 'py> FromPyObject<'a, 'py> for Like<'py> {
    type Error = PyErr;

    fn extract(given: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        let columns = given.getattr("columns").and_then(|columns| columns.try_iter());
        let columns = columns.and_then(|names| names.map(|name| name?.extract()).collect::<PyResult<_>>());
        Ok(Self { array: given.extract()?, columns: columns.unwrap_or_default() })
    }
}

/// Rows of an array, `rows × width`.
pub struct Rows<'a> {
    /// The numbers, all finite. Borrowed if they lie side by side.
    pub values: Cow<'a, [f32]>,
    /// How many rows; 1 for an array of one axis.
    pub count: usize,
    /// Whether the array has one axis.
    pub single: bool,
}

impl<'a> Rows<'a> {
    /// The rows of an array, called `name` to the user, each of `width` numbers: `[n, width]` or `[width]`. These have the names
    /// `names`, or none.
    ///
    /// # Errors
    /// ValueError for another shape, for a table whose columns are others, and for NaN or an infinite number.
    pub fn of(name: &str, Like { array, columns }: &'a Like<'_>, width: usize, names: &[String]) -> PyResult<Self> {
        let list = names.join(", ");
        if !names.is_empty() && !columns.is_empty() && columns != names {
            let columns = columns.join(", ");
            let error = format!("{name} has the columns {columns}, but the policy takes, in this order, {list}");
            return Err(PyValueError::new_err(error));
        }
        let (count, single) = match *array.shape() {
            [columns] if columns == width => (1, true),
            [count, columns] if columns == width => (count, false),
            ref shape => {
                let shape = shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
                let list = if names.is_empty() { list } else { format!(": {list}") };
                let error = format!("{name} has shape [{shape}], but must have [n, {width}] or [{width}]{list}");
                return Err(PyValueError::new_err(error));
            }
        };
        let values = match array.as_slice() {
            // Columns may lie side by side, too.
            Ok(values) if array.is_c_contiguous() => Cow::Borrowed(values),
            _ => Cow::Owned(array.as_array().iter().copied().collect()),
        };
        if let Some(i) = values.iter().position(|value| !value.is_finite()) {
            let (row, column, value) = (i / width, i % width, values[i]);
            let error = format!("{name}, row {row}: number {column} is {value}, but must be a finite float32");
            return Err(PyValueError::new_err(error));
        }
        Ok(Self { values, count, single })
    }

    /// An array of a row of that shape for each of these rows, without the axis of rows if these lack it.
    pub fn array<'py, T: Element>(
        &self,
        py: Python<'py>,
        values: Vec<T>,
        row: &[usize],
    ) -> PyResult<Bound<'py, PyArrayDyn<T>>> {
        let front: &[usize] = if self.single { &[] } else { &[self.count] };
        PyArray::from_vec(py, values).reshape([front, row].concat())
    }
}
