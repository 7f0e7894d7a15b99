//! Histograms, drawn as text.

use std::fmt;

use serde::Serialize;

const BINS: usize = 12;

const WIDTH: usize = 40;

/// Counts in bins of equal width. A number on an inner edge belongs to the upper bin.
#[derive(Debug, PartialEq, Serialize)]
pub struct Histogram {
    /// Lower edge of the first bin.
    pub from: f64,
    /// Upper edge of the last bin.
    pub to: f64,
    /// Count in each bin: one bin if all numbers are equal, no bin without numbers.
    pub counts: Vec<usize>,
}

impl Histogram {
    pub(super) fn of(values: &[f64]) -> Self {
        let from = values.iter().copied().fold(f64::NAN, f64::min);
        let to = values.iter().copied().fold(f64::NAN, f64::max);
        let bins = match (values.len(), from == to) {
            (0, _) => 0,
            (_, true) => 1,
            (_, false) => BINS,
        };
        let mut counts = vec![0; bins];
        for value in values {
            let bin = ((value - from) / (to - from) * bins as f64) as usize; // NaN becomes 0
            counts[bin.min(bins - 1)] += 1;
        }
        Self { from, to, counts }
    }
}

impl fmt::Display for Histogram {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let bins = self.counts.len();
        let most = self.counts.iter().copied().max().unwrap_or(1);
        for (bin, &count) in self.counts.iter().enumerate() {
            let edge = |bin: usize| self.from + (self.to - self.from) * bin as f64 / bins as f64;
            // Nonzero counts get at least one character.
            let bar = "#".repeat((count * WIDTH).div_ceil(most));
            writeln!(
                f,
                "  {:>10.2} to {:>10.2}  {bar:<WIDTH$}  {count}",
                edge(bin),
                edge(bin + 1)
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_is_in_one_bin() {
        let values: Vec<f64> = (0..=24).map(f64::from).collect();
        let histogram = Histogram::of(&values);
        assert_eq!((histogram.from, histogram.to), (0.0, 24.0));
        assert_eq!(histogram.counts, [2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 3]);
        assert_eq!(Histogram::of(&[5.0; 3]).counts, [3]);
        assert!(Histogram::of(&[]).counts.is_empty());
    }
}
