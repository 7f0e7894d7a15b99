//! Summary statistics of numbers, and the lengths and returns of episodes.

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
    pub(crate) fn of(values: &[f64]) -> Self {
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
    pub(crate) fn of_columns(
        values: &[f32],
        width: usize,
        counts: impl Fn(usize) -> bool,
    ) -> Vec<Self> {
        let column = |column: usize| {
            let values = values.iter().skip(column).step_by(width).enumerate();
            let values = values.filter(|(row, value)| counts(*row) && value.is_finite());
            Self::of(&Vec::from_iter(values.map(|(_, value)| f64::from(*value))))
        };
        (0..width).map(column).collect()
    }
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Episode {
    pub(crate) length: usize,
    pub(crate) sum: f64,
    reached: bool,
}

impl Episode {
    /// Adds a step. With a `goal`, rewards after the first positive one do not count.
    pub(crate) fn push(&mut self, reward: f64, goal: bool) {
        self.length += 1;
        if !self.reached {
            self.sum += reward;
        }
        self.reached |= goal && reward > 0.0;
    }
}
