//! Arrays from Python as rows of numbers, and back.

use numpy::{
    AllowTypeChange, Element, PyArray, PyArrayDyn, PyArrayLikeDyn, PyArrayMethods,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::borrow::Cow;

/// What Python gives for an array: float32 as it is, anything else that NumPy takes, converted.
pub struct Like<'py> {
    array: PyArrayLikeDyn<'py, f32, AllowTypeChange>,
    /// The names that a table, such as pandas's, has for its columns, or a dictionary's keys.
    columns: Vec<String>,
    /// Whether it was a dictionary, whose numbers go by their names, in any order.
    by_name: bool,
}

impl<'a, 'py> FromPyObject<'a, 'py> for Like<'py> {
    type Error = PyErr;

    fn extract(given: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        if let Ok(numbers) = given.cast::<PyDict>() {
            let array =
                given.py().import("numpy")?.call_method1("stack", (numbers.values(), -1))?;
            return Ok(Self {
                array: array.extract()?,
                columns: numbers.keys().extract()?,
                by_name: true,
            });
        }
        let columns = given.getattr("columns").and_then(|columns| columns.try_iter());
        let columns =
            columns.and_then(|names| names.map(|name| name?.extract()).collect::<PyResult<_>>());
        Ok(Self { array: given.extract()?, columns: columns.unwrap_or_default(), by_name: false })
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
    /// The rows of an array, called `name` to the user, each of `width` numbers: `[n, width]` or
    /// `[width]`. These have the names `names`, or none. A dictionary of `[n]` or of single numbers
    /// is read by these names; what else it has is not looked at.
    ///
    /// # Errors
    /// ValueError for another shape, for a table whose columns are others, for a dictionary that
    /// lacks one, and for NaN or an infinite number.
    pub fn of(name: &str, given: &'a Like<'_>, width: usize, names: &[String]) -> PyResult<Self> {
        let Like { array, columns, by_name } = given;
        let list = names.join(", ");
        if !by_name && !names.is_empty() && !columns.is_empty() && columns != names {
            let columns = columns.join(", ");
            let error = format!(
                "{name} has the columns {columns}, but the policy takes, in this order, {list}"
            );
            return Err(PyValueError::new_err(error));
        }
        let places = if *by_name { places(name, columns, names)? } else { Vec::new() };
        let across = if *by_name { columns.len() } else { width };
        let (count, single) = match *array.shape() {
            [columns] if columns == across => (1, true),
            [count, columns] if columns == across => (count, false),
            ref shape => {
                let shape = shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
                let list = if names.is_empty() { list } else { format!(": {list}") };
                let error = format!(
                    "{name} has shape [{shape}], but must have [n, {width}] or [{width}]{list}"
                );
                return Err(PyValueError::new_err(error));
            }
        };
        let values = match array.as_slice() {
            _ if *by_name => {
                let all: Vec<f32> = array.as_array().iter().copied().collect();
                Cow::Owned(
                    all.chunks(across)
                        .flat_map(|row| places.iter().map(|place| row[*place]))
                        .collect(),
                )
            }
            // Columns may lie side by side, too.
            Ok(values) if array.is_c_contiguous() => Cow::Borrowed(values),
            _ => Cow::Owned(array.as_array().iter().copied().collect()),
        };
        if let Some(i) = values.iter().position(|value| !value.is_finite()) {
            let (row, column, value) = (i / width, i % width, values[i]);
            let called = names.get(column).map_or(String::new(), |name| format!(" ({name})"));
            let error = format!(
                "{name}, row {row}: number {column}{called} is {value}, but must be a finite float32"
            );
            return Err(PyValueError::new_err(error));
        }
        Ok(Self { values, count, single })
    }

    /// An array of a row of that shape for each of these rows, without the axis of rows if these
    /// lack it.
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

/// The place of each name among a dictionary's keys.
fn places(name: &str, keys: &[String], names: &[String]) -> PyResult<Vec<usize>> {
    if names.is_empty() {
        let error = format!(
            "{name} is a dictionary, but the policy's data has no names\nhint: give its numbers in its order"
        );
        return Err(PyValueError::new_err(error));
    }
    let place = |name: &String| keys.iter().position(|key| key == name);
    let lacking: Vec<_> =
        names.iter().filter(|name| place(name).is_none()).map(String::as_str).collect();
    if !lacking.is_empty() {
        let error = format!("{name} lacks {}; it has {}", lacking.join(", "), keys.join(", "));
        return Err(PyValueError::new_err(error));
    }
    Ok(names.iter().filter_map(place).collect())
}
