//! The summary as text, with histograms.

use std::fmt;

use serde::Serialize;

use super::Inspection;
use crate::recording::named;
use crate::statistics::Range;

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for file in &self.files {
            write!(f, "{}", file.path.display())?;
            if self.files.len() > 1 {
                write!(f, ": {file}")?;
            }
            writeln!(f)?;
        }
        let share = |share: f64| format!("{:.3} % of the steps", 100.0 * share);
        let constant = |columns: &[usize], names: &[String]| match columns {
            [] => String::new(),
            _ => format!("; constant: {}", named(columns, names)),
        };
        let constant_states = constant(&self.constant_observations, &self.observation_names);
        let constant_actions = constant(&self.constant_actions, &self.action_names);
        let (o, a, size) = (self.observation_dim, self.action_dim, self.reward_size);
        let size = format!("of size {size:.4} (root mean square)");
        let environment = self.environment.as_deref().unwrap_or("not known");
        for (name, text) in [
            ("format", self.format.clone()),
            ("environment", environment.to_owned()),
            ("transitions", self.transitions.to_string()),
            ("episodes", self.episodes.to_string()),
            ("terminals", share(self.terminals)),
            ("timeouts", share(self.timeouts)),
            ("observations", format!("{o} numbers{constant_states}")),
            ("actions", format!("{a} numbers{constant_actions}")),
            ("rewards", format!("{size}; methods are made for about 1")),
        ] {
            writeln!(f, "  {name:<14}{text}")?;
        }

        let names = self.action_names.iter();
        let wide = names.map(|name| name.chars().count() + 1);
        let wide = wide.fold(14, usize::max);
        let numbers = |numbers: [f64; 3], digits: usize| numbers.map(|x| format!("{x:.digits$}"));
        let range = |Range { min, max }: Range| {
            let [min, max] = [min, max].map(|x| format!("{x:.4}"));
            [min, String::new(), max]
        };
        writeln!(f)?;
        let mut row = |name: &str, [min, mean, max]: [String; 3]| {
            writeln!(f, "  {name:<wide$}{min:>12}{mean:>12}{max:>12}")
        };
        row("", ["min", "mean", "max"].map(str::to_owned))?;
        let lengths = [self.min_length, self.mean_length, self.max_length];
        row("length", numbers(lengths, 1))?;
        let returns = [self.min_return, self.mean_return, self.max_return];
        row("return", numbers(returns, 2))?;
        if let Some(scores) = &self.scores {
            let scores = [scores.min_score, scores.mean_score, scores.max_score];
            row("score", numbers(scores, 2))?;
        }
        row("reward", range(self.reward_range))?;
        row("observation", range(self.observation_range))?;
        row("action", range(self.action_range))?;
        for (i, action) in self.action_ranges.iter().enumerate() {
            let number = format!("action {i}");
            let name = self.action_names.get(i).unwrap_or(&number);
            row(name, range(*action))?;
        }

        write!(f, "\nreturns of the episodes\n{}", self.returns)?;
        write!(f, "\nlengths of the episodes\n{}", self.lengths)?;
        if self.problems.is_empty() {
            return write!(f, "\nno problems found");
        }
        let verdict = match self.refused {
            true => "training refuses this dataset",
            false => "it can be trained on",
        };
        write!(f, "\nproblems ({verdict})")?;
        let mut problems = self.problems.iter();
        problems.try_for_each(|problem| write!(f, "\n  - {problem}"))
    }
}

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
    pub(super) fn new(values: &[f64]) -> Self {
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
        let histogram = Histogram::new(&values);
        assert_eq!((histogram.from, histogram.to), (0.0, 24.0));
        assert_eq!(histogram.counts, [2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 3]);
        assert_eq!(Histogram::new(&[5.0; 3]).counts, [3]);
        assert!(Histogram::new(&[]).counts.is_empty());
    }
}
