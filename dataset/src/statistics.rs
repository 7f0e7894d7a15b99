//! Summary statistics of numbers, and the lengths and returns of episodes.

use serde::Serialize;

/// Statistics of some numbers; NaN without numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Summary {
    pub(crate) min: f64,
    pub(crate) mean: f64,
    pub(crate) max: f64,
    pub(crate) deviation: f64,
    /// Root mean square.
    pub(crate) rms: f64,
}

impl Summary {
    pub(crate) fn new(values: &[f64]) -> Self {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let square_around =
            |center: f64| values.iter().map(|x| (x - center).powi(2)).sum::<f64>() / count;
        Self {
            min: values.iter().copied().fold(f64::NAN, f64::min),
            mean,
            max: values.iter().copied().fold(f64::NAN, f64::max),
            deviation: square_around(mean).sqrt(),
            rms: square_around(0.0).sqrt(),
        }
    }

    /// Statistics of each column's finite numbers in the rows that count.
    pub(crate) fn columns(
        values: &[f32],
        width: usize,
        counts: impl Fn(usize) -> bool,
    ) -> Vec<Self> {
        let column = |column: usize| {
            let values = values.iter().skip(column).step_by(width).enumerate();
            let values = values.filter(|(row, value)| counts(*row) && value.is_finite());
            Self::new(&Vec::from_iter(values.map(|(_, value)| f64::from(*value))))
        };
        (0..width).map(column).collect()
    }
}

/// Smallest and largest of some numbers; NaN without numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[allow(missing_docs)] // The names say what each is.
pub struct Range {
    pub min: f64,
    pub max: f64,
}

impl Range {
    /// Ranges of each column's finite numbers in the rows that count.
    pub(crate) fn columns(
        values: &[f32],
        width: usize,
        counts: impl Fn(usize) -> bool,
    ) -> Vec<Self> {
        let mut ranges = vec![Self::over(&[]); width];
        let rows = values.chunks_exact(width.max(1)).enumerate();
        for (_, values) in rows.filter(|(row, _)| counts(*row)) {
            for (range, value) in ranges.iter_mut().zip(values) {
                if value.is_finite() {
                    range.min = range.min.min(f64::from(*value));
                    range.max = range.max.max(f64::from(*value));
                }
            }
        }
        ranges
    }

    pub(crate) fn over(ranges: &[Self]) -> Self {
        let min = ranges.iter().map(|range| range.min);
        let max = ranges.iter().map(|range| range.max);
        Self { min: min.fold(f64::NAN, f64::min), max: max.fold(f64::NAN, f64::max) }
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct EpisodeReturn {
    pub(crate) length: usize,
    pub(crate) sum: f64,
}
