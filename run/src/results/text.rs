//! A run's results as text.

use std::fmt::Alignment::Right;

use super::report::RunReport;
use crate::counted;
use crate::table::{Style, Table};

impl RunReport {
    /// The evaluations as a table, with the run's settings above and means below.
    pub fn text(&self) -> String {
        let measure = self.measure();
        // Without reference returns, the score is the return, unless the evaluator defines it.
        let has_both = measure == "score";
        let mut header = vec!["step", "episodes", measure, "length"];
        if has_both {
            header.insert(3, "return");
        }
        if self.config.experiment.online.is_some() {
            header.insert(1, "online");
        }
        let mut table = Table::new(&Vec::from_iter(header.into_iter().map(|name| (name, Right))));
        for e in &self.evaluations {
            let episodes = e.episodes.to_string() + if e.complete { "" } else { " (part)" };
            let length = format!("{:.1}", e.mean_length);
            let mut row = vec![e.step.to_string(), episodes, e.score.text(), length];
            if has_both {
                row.insert(3, format!("{:.1}", e.mean_return));
            }
            if let Some(steps) = e.environment_steps {
                row.insert(1, steps.to_string());
            }
            table.push(row);
        }
        let (run, task, agent) = (&self.run, &self.task, &self.agent);
        let (steps, seed, unit) = (self.steps, self.seed, self.measure_with_unit());
        let mut text = format!("{run}: task {task}, {agent}, {steps} steps, seed {seed}; {unit}");
        match self.evaluations.is_empty() {
            true if self.is_complete() => text += "\n\n(the run has no evaluations)\n",
            true => text += "\n\n(no evaluation has a score yet)\n",
            false => {
                text += &format!(", scored in {}\n\n", self.scored_in);
                text += &table.render(Style::Text);
            }
        }
        if !self.is_complete() {
            let missing = counted(self.episodes_missing as usize, "episode");
            text += &format!("{missing} without a score: {}\n", self.how_complete());
        }
        text.push('\n');
        for (name, mean) in [
            ("last 3 evaluations:", self.mean_last_3),
            ("last 5 evaluations:", self.mean_last_5),
            ("last 50000 steps:", self.mean_last_50000_steps),
            ("dataset:", self.dataset_measure()),
        ] {
            if let Some(mean) = mean {
                text += &format!("mean {measure} of the {name:19} {mean:.2}\n");
            }
        }
        let summary = self.summary.as_ref().map(|summary| format!("\n{}", summary.text));
        text + &summary.unwrap_or_default()
    }
}
