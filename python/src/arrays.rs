//! Conversion between Python's arrays and rows of numbers.

use numpy::{
    AllowTypeChange, Element, PyArray, PyArrayDyn, PyArrayLikeDyn, PyArrayMethods,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::borrow::Cow;

/// An array-like argument.
pub enum ArrayLike<'py> {
    /// Float32 arrays as they are, anything else converted by NumPy; and the columns of a table, such
    /// as pandas's.
    Array(PyArrayLikeDyn<'py, f32, AllowTypeChange>, Vec<String>),
    /// Numbers by their names, in any order.
    Numbers(Bound<'py, PyDict>),
}

impl<'a, 'py> FromPyObject<'a, 'py> for ArrayLike<'py> {
    type Error = PyErr;

    fn extract(given: Borrowed<'a, 'py, PyAny>) -> PyResult<Self> {
        if let Ok(numbers) = given.cast::<PyDict>() {
            return Ok(Self::Numbers(numbers.to_owned()));
        }
        let names = given.getattr("columns").and_then(|columns| columns.try_iter());
        let names = names.and_then(|names| names.map(|name| name?.extract()).collect());
        Ok(Self::Array(given.extract()?, names.unwrap_or_default()))
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
    pub fn new(
        name: &str,
        given: &'a ArrayLike<'_>,
        width: usize,
        names: &[String],
    ) -> PyResult<Self> {
        let (array, columns) = match given {
            ArrayLike::Array(array, columns) => (array, columns),
            ArrayLike::Numbers(numbers) => {
                let array: PyArrayLikeDyn<'_, f32, AllowTypeChange> =
                    stacked(name, numbers, names)?.extract()?;
                let rows = Rows::from_array(name, &array, width, names)?;
                return Ok(Self {
                    values: Cow::Owned(rows.values.into_owned()),
                    count: rows.count,
                    single: rows.single,
                });
            }
        };
        if !names.is_empty() && !columns.is_empty() && columns != names {
            let (columns, list) = (columns.join(", "), names.join(", "));
            return Err(PyValueError::new_err(format!(
                "{name} has the columns {columns}, but the policy takes, in this order, {list}"
            )));
        }
        Self::from_array(name, array, width, names)
    }

    fn from_array(
        name: &str,
        array: &'a PyArrayLikeDyn<'_, f32, AllowTypeChange>,
        width: usize,
        names: &[String],
    ) -> PyResult<Self> {
        let refused = |error| Err(PyValueError::new_err(error));
        let (count, single) = match *array.shape() {
            [columns] if columns == width => (1, true),
            [count, columns] if columns == width => (count, false),
            ref shape => {
                let list = match names {
                    [] => String::new(),
                    _ => format!(": {}", names.join(", ")),
                };
                return refused(format!(
                    "{name} has shape {shape:?}, but must have [n, {width}] or [{width}]{list}"
                ));
            }
        };
        let values = match array.as_slice() {
            // A slice may also have the order of columns.
            Ok(values) if array.is_c_contiguous() => Cow::Borrowed(values),
            _ => Cow::Owned(array.as_array().iter().copied().collect()),
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

/// An array of a dictionary's numbers of these names, `[width]` or `[n, width]`.
fn stacked<'py>(
    name: &str,
    numbers: &Bound<'py, PyDict>,
    names: &[String],
) -> PyResult<Bound<'py, PyAny>> {
    if names.is_empty() {
        let error = format!(
            "{name} is a dictionary, but the policy's data has no names\nhint: give its numbers in its order"
        );
        return Err(PyValueError::new_err(error));
    }
    let (mut columns, mut lacking) = (Vec::new(), Vec::new());
    if let Some((_, column)) = names.iter().enumerate().find(|(i, name)| names[..*i].contains(name))
    {
        return Err(PyValueError::new_err(format!(
            "{name} is a dictionary, but the policy's data has several columns {column:?}\nhint: give its numbers in its order"
        )));
    }
    for name in names {
        match numbers.get_item(name)? {
            Some(number) => columns.push(number),
            None => lacking.push(name.as_str()),
        }
    }
    if !lacking.is_empty() {
        let keys = Vec::from_iter(numbers.keys().iter().map(|key| key.to_string()));
        let error = format!("{name} lacks {}; it has {}", lacking.join(", "), keys.join(", "));
        return Err(PyValueError::new_err(error));
    }
    numbers.py().import("numpy")?.call_method1("stack", (columns, -1))
}
