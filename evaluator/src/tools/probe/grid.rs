//! Tables of estimates.

use std::fmt;
use std::fmt::Alignment::{Left, Right};

use quad_run::results::statistics::{Estimate, estimates, mean};
use quad_run::table::{Style, Table};
use serde::Serialize;

/// Estimates, with 95 % bootstrap intervals over states.
#[derive(Serialize)]
pub struct Grid {
    pub title: &'static str,
    pub columns: Vec<&'static str>,
    /// A name, and an estimate for each column.
    pub rows: Vec<(String, Vec<Estimate>)>,
}

impl Grid {
    /// `statistics` computes the numbers of all rows, one after the other, from a sample of `states`.
    pub fn of<T>(
        title: &'static str,
        columns: &[&'static str],
        names: impl IntoIterator<Item = String>,
        states: &[T],
        statistics: impl Fn(&[&T]) -> Vec<f64>,
    ) -> Self {
        let all = vec![Vec::from_iter(states)];
        let found = estimates(&[&all], |drawn| statistics(&drawn[0][0]));
        let rows = names.into_iter().zip(found.chunks(columns.len()).map(<[_]>::to_vec));
        Self { title, columns: columns.to_vec(), rows: rows.collect() }
    }
}

/// The mean of some vectors.
pub fn means(vectors: &[impl AsRef<[f64]>]) -> Vec<f64> {
    let column =
        |at: usize| mean(&Vec::from_iter(vectors.iter().map(|vector| vector.as_ref()[at])));
    (0..vectors[0].as_ref().len()).map(column).collect()
}

impl fmt::Display for Grid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let columns = self.columns.iter().map(|name| (*name, Right));
        let mut table = Table::new(&Vec::from_iter([("", Left)].into_iter().chain(columns)));
        for (name, numbers) in &self.rows {
            let numbers = numbers.iter().map(|number| number.text(3));
            table.push(Vec::from_iter([name.clone()].into_iter().chain(numbers)));
        }
        write!(f, "{}\n{}", self.title, table.render(Style::Text))
    }
}
