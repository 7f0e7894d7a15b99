use std::fmt;

use super::{Inspection, Range};
use crate::warnings::named;

impl fmt::Display for Inspection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.path.display())?;
        let environment = self.environment.as_deref().unwrap_or("not known");
        writeln!(f, "  format        {}", self.format)?;
        writeln!(f, "  environment   {environment}")?;
        writeln!(f, "  transitions   {}", self.transitions)?;
        writeln!(f, "  episodes      {}", self.episodes)?;
        writeln!(f, "  terminals     {:.3} % of the steps", 100.0 * self.terminals)?;
        writeln!(f, "  timeouts      {:.3} % of the steps", 100.0 * self.timeouts)?;
        let constant = |columns: &[usize], names: &[String]| match columns {
            [] => String::new(),
            _ => format!("; constant: {}", named(columns, names)),
        };
        let of_observations = constant(&self.constant_observations, &self.observation_names);
        writeln!(f, "  observations  {} numbers{of_observations}", self.observation_dim)?;
        let of_actions = constant(&self.constant_actions, &self.action_names);
        writeln!(f, "  actions       {} numbers{of_actions}", self.action_dim)?;
        writeln!(
            f,
            "  rewards       of size {:.4} (root mean square); methods are made for about 1",
            self.reward_size
        )?;

        let wide =
            self.action_names.iter().map(|name| name.chars().count() + 1).fold(14, usize::max);
        writeln!(f, "\n  {:<wide$}{:>12}{:>12}{:>12}", "", "min", "mean", "max")?;
        let mut row = |name: &str, [min, mean, max]: [f64; 3], digits: usize| {
            writeln!(f, "  {name:<wide$}{min:>12.digits$}{mean:>12.digits$}{max:>12.digits$}")
        };
        row("length", [self.min_length, self.mean_length, self.max_length], 1)?;
        row("return", [self.min_return, self.mean_return, self.max_return], 2)?;
        if let Some(scores) = &self.scores {
            row("score", [scores.min_score, scores.mean_score, scores.max_score], 2)?;
        }
        let mut row = |name: &str, range: Range| {
            writeln!(f, "  {name:<wide$}{:>12.4}{:>12}{:>12.4}", range.min, "", range.max)
        };
        row("reward", self.reward_range)?;
        row("observation", self.observation_range)?;
        row("action", self.action_range)?;
        for (i, range) in self.action_ranges.iter().enumerate() {
            row(self.action_names.get(i).unwrap_or(&format!("action {i}")), *range)?;
        }

        write!(f, "\nreturns of the episodes\n{}", self.returns)?;
        write!(f, "\nlengths of the episodes\n{}", self.lengths)?;
        match self.problems.is_empty() {
            true => write!(f, "\nno problems found"),
            false => {
                let verdict = if self.refused {
                    "training refuses this dataset"
                } else {
                    "it can be trained on"
                };
                write!(f, "\nproblems ({verdict})")?;
                self.problems.iter().try_for_each(|problem| write!(f, "\n  - {problem}"))
            }
        }
    }
}
