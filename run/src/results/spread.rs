//! Mean and standard deviation, by both of its conventions.

use serde::Serialize;

use super::statistics::mean;

/// Mean and standard deviation of some values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// Sample standard deviation (divided by n - 1); absent for a single value.
    pub std: Option<f64>,
    /// Population standard deviation (divided by n), as in DAC's code; absent for a single value.
    pub population_std: Option<f64>,
}

impl Spread {
    /// Spread of some values; `None` without any.
    pub fn new(values: &[f64]) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        let (mean, count) = (mean(values), values.len() as f64);
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let std = |divisor: f64| (values.len() > 1).then(|| (squares / divisor).sqrt());
        Some(Self { mean, std: std(count - 1.0), population_std: std(count) })
    }

    /// `mean ± std`, by n - 1.
    pub fn text(self) -> String {
        let std = self.std.map(|std| format!(" ± {std:.2}"));
        format!("{:.2}{}", self.mean, std.unwrap_or_default())
    }

    /// `mean ± std (std)`, by n - 1 and by n.
    pub fn text_with_population(self) -> String {
        let population = self.population_std.map(|std| format!(" ({std:.2})"));
        self.text() + &population.unwrap_or_default()
    }
}
