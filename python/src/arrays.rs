//! Conversion between Python's arrays and rows of numbers.

use numpy::{
    AllowTypeChange, Element, PyArray, PyArrayDyn, PyArrayLikeDyn, PyArrayMethods,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::borrow::Cow;

/// An array-like argument: float32 arrays as they are, anything else converted by NumPy.
pub struct ArrayLike<'py> {
    array: PyArrayLikeDyn<'py, f32, AllowTypeChange>,
    /// Columns of a table, such as pandas's, or keys of a dictionary.
    columns: Vec<String>,
    /// True if it was a dictionary, whose order does not count.
    by_name: bool,
}

impl<'a, 'py> FromPyObject<'a, 'py> for ArrayLike<'py> {
    type Error = PyErr;

    fn extract(given: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        if let Ok(numbers) = given.cast::<PyDict>() {
            let array =
                given.py().import("numpy")?.call_method1("stack", (numbers.values(), -1))?;
            let columns = numbers.keys().extract()?;
            return Ok(Self { array: array.extract()?, columns, by_name: true });
        }
        let names = given.getattr("columns").and_then(|columns| columns.try_iter());
        let names = names.and_then(|names| names.map(|name| name?.extract()).collect());
        let columns = names.unwrap_or_default();
        Ok(Self { array: given.extract()?, columns, by_name: false })
    }
}

/// Rows of an array, `rows × width`.
pub struct Rows<'a> {
    /// Finite numbers, borrowed if the array is contiguous.
    pub values: Cow<'a, [f32]>,
    /// Number of rows; 1 for an array of one axis.
    pub count: usize,
    /// True if the array has one axis.
    pub single: bool,
}

impl<'a> Rows<'a> {
    /// The rows of an array `[n, width]` or `[width]`, which errors call `name`. `names` are the names
    /// of the columns, or empty. A dictionary of `[n]` or of single numbers is read by these names,
    /// its other keys are ignored. Other shapes, columns, and numbers that are not finite are
    /// ValueErrors.
    pub fn of(
        name: &str,
        given: &'a ArrayLike<'_>,
        width: usize,
        names: &[String],
    ) -> PyResult<Self> {
        let ArrayLike { array, columns, by_name } = given;
        let (list, refused) = (names.join(", "), |error| Err(PyValueError::new_err(error)));
        if !by_name && !names.is_empty() && !columns.is_empty() && columns != names {
            let columns = columns.join(", ");
            return refused(format!(
                "{name} has the columns {columns}, but the policy takes, in this order, {list}"
            ));
        }
        let places = if *by_name { places(name, columns, names)? } else { Vec::new() };
        let across = if *by_name { columns.len() } else { width };
        let (count, single) = match *array.shape() {
            [columns] if columns == across => (1, true),
            [count, columns] if columns == across => (count, false),
            ref shape => {
                let shape = shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
                let list = if names.is_empty() { list } else { format!(": {list}") };
                return refused(format!(
                    "{name} has shape [{shape}], but must have [n, {width}] or [{width}]{list}"
                ));
            }
        };
        let copied = || Vec::from_iter(array.as_array().iter().copied());
        let values = match array.as_slice() {
            _ if *by_name => {
                let all = copied();
                let of_row = |row: &[f32]| Vec::from_iter(places.iter().map(|place| row[*place]));
                Cow::Owned(all.chunks(across).flat_map(of_row).collect())
            }
            // A slice may also have the order of columns.
            Ok(values) if array.is_c_contiguous() => Cow::Borrowed(values),
            _ => Cow::Owned(copied()),
        };
        if let Some(i) = values.iter().position(|value| !value.is_finite()) {
            let (row, column, value) = (i / width, i % width, values[i]);
            let called = names.get(column).map_or(String::new(), |name| format!(" ({name})"));
            return refused(format!(
                "{name}, row {row}: number {column}{called} is {value}, but must be a finite float32"
            ));
        }
        Ok(Self { values, count, single })
    }

    /// An array `[count, row...]`; `[row...]` for a single row.
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

/// The position of each name among a dictionary's keys.
fn places(name: &str, keys: &[String], names: &[String]) -> PyResult<Vec<usize>> {
    if names.is_empty() {
        let error = format!(
            "{name} is a dictionary, but the policy's data has no names\nhint: give its numbers in its order"
        );
        return Err(PyValueError::new_err(error));
    }
    let lacking = Vec::from_iter(names.iter().filter(|name| !keys.contains(name)).cloned());
    if !lacking.is_empty() {
        let error = format!("{name} lacks {}; it has {}", lacking.join(", "), keys.join(", "));
        return Err(PyValueError::new_err(error));
    }
    Ok(names.iter().filter_map(|name| keys.iter().position(|key| key == name)).collect())
}
