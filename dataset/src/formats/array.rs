use crate::error::Problem;

/// N rows of numbers, read from shape N × width, or N if the width is 1. `values` is N × width.
pub(crate) struct Array<T> {
    name: String,
    shape: Vec<usize>,
    pub(crate) width: usize,
    pub(crate) values: Vec<T>,
}

impl<T> Array<T> {
    pub(crate) fn new(name: &str, shape: &[usize], values: Vec<T>) -> Result<Self, Problem> {
        let (name, shape) = (name.to_owned(), shape.to_vec());
        match shape[..] {
            [_] => Ok(Self { name, shape, width: 1, values }),
            [_, width] if width > 0 => Ok(Self { name, shape, width, values }),
            _ => Err(Problem::Axes { array: name, found: shape }),
        }
    }

    pub(crate) fn rows(&self) -> usize {
        self.shape[0]
    }

    pub(crate) fn row(&self, row: usize) -> &[T] {
        &self.values[row * self.width..(row + 1) * self.width]
    }

    pub(crate) fn of_rows(self, rows: usize) -> Result<Self, Problem> {
        match self.rows() == rows {
            true => Ok(self),
            false => Err(Problem::Shape {
                expected: vec![rows, self.width],
                array: self.name,
                found: self.shape,
            }),
        }
    }

    pub(crate) fn sized(self, rows: usize, width: usize) -> Result<Vec<T>, Problem> {
        match (self.rows(), self.width) == (rows, width) {
            true => Ok(self.values),
            false => Err(Problem::Shape {
                array: self.name,
                found: self.shape,
                expected: vec![rows, width],
            }),
        }
    }
}

impl Array<f32> {
    /// One flag per row; all values must be 0 or 1.
    pub(crate) fn into_flags(self, rows: usize) -> Result<Vec<bool>, Problem> {
        let name = self.name.clone();
        let values = self.sized(rows, 1)?;
        match values.iter().position(|&value| value != 0.0 && value != 1.0) {
            None => Ok(values.into_iter().map(|value| value == 1.0).collect()),
            Some(row) => Err(Problem::NotBoolean { array: name, row, value: values[row] }),
        }
    }
}
