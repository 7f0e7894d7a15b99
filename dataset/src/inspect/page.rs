//! The summary as text.

use std::fmt;

use super::{Inspection, Range};
use crate::recording::named;

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.path.display())?;
        let share = |share: f64| format!("{:.3} % of the steps", 100.0 * share);
        let constant = |columns: &[usize], names: &[String]| match columns {
            [] => String::new(),
            _ => format!("; constant: {}", named(columns, names)),
        };
        let of_states = constant(&self.constant_observations, &self.observation_names);
        let of_actions = constant(&self.constant_actions, &self.action_names);
        let (o, a, size) = (self.observation_dim, self.action_dim, self.reward_size);
        let size = format!("of size {size:.4} (root mean square)");
        for (name, text) in [
            ("format", self.format.to_owned()),
            ("environment", self.environment.clone().unwrap_or("not known".to_owned())),
            ("transitions", self.transitions.to_string()),
            ("episodes", self.episodes.to_string()),
            ("terminals", share(self.terminals)),
            ("timeouts", share(self.timeouts)),
            ("observations", format!("{o} numbers{of_states}")),
            ("actions", format!("{a} numbers{of_actions}")),
            ("rewards", format!("{size}; methods are made for about 1")),
        ] {
            writeln!(f, "  {name:<14}{text}")?;
        }

        let names = self.action_names.iter();
        let wide = names.map(|name| name.chars().count() + 1).fold(14, usize::max);
        writeln!(f, "\n  {:<wide$}{:>12}{:>12}{:>12}", "", "min", "mean", "max")?;
        let mut row = |name: &str, [min, mean, max]: [f64; 3], digits: usize| {
            writeln!(f, "  {name:<wide$}{min:>12.digits$}{mean:>12.digits$}{max:>12.digits$}")
        };
        let (min, mean, max) = (self.min_length, self.mean_length, self.max_length);
        row("length", [min, mean, max], 1)?;
        let (min, mean, max) = (self.min_return, self.mean_return, self.max_return);
        row("return", [min, mean, max], 2)?;
        if let Some(of) = &self.scores {
            row("score", [of.min_score, of.mean_score, of.max_score], 2)?;
        }
        let mut row = |name: &str, range: Range| {
            writeln!(f, "  {name:<wide$}{:>12.4}{:>12}{:>12.4}", range.min, "", range.max)
        };
        row("reward", self.reward_range)?;
        row("observation", self.observation_range)?;
        row("action", self.action_range)?;
        for (i, range) in self.action_ranges.iter().enumerate() {
            let number = format!("action {i}");
            row(self.action_names.get(i).unwrap_or(&number), *range)?;
        }

        write!(f, "\nreturns of the episodes\n{}", self.returns)?;
        write!(f, "\nlengths of the episodes\n{}", self.lengths)?;
        self.write_problems(f)
    }
}

impl Inspection {
    fn write_problems(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
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
