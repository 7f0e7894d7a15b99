//! The whole report: a table of each run, a summary over seeds, and the paper's figures beside it.

use std::fmt::Alignment::{Left, Right};
use std::path::PathBuf;

use serde::Serialize;

use super::run::RunReport;
use super::seeds::{self, GroupReport};
use super::spread::Spread;
use super::table::{Style, Table};

/// What `learner report` says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Each folder.
    pub runs: Vec<RunReport>,
    /// The folders summarised over seeds.
    pub groups: Vec<GroupReport>,
}

impl Report {
    /// Reads run folders.
    ///
    /// # Errors
    /// One of them holds no run, or a file that no learner writes.
    pub fn read(paths: &[PathBuf]) -> anyhow::Result<Self> {
        let runs: Vec<_> = paths.iter().map(|path| RunReport::read(path)).collect::<anyhow::Result<_>>()?;
        Ok(Self { groups: seeds::groups(&runs), runs })
    }

    /// A table of each run; with several runs the summary over seeds; for tasks of the paper, its figures.
    pub fn text(&self) -> String {
        let mut parts: Vec<_> = self.runs.iter().map(RunReport::table).collect();
        if self.runs.len() > 1 {
            parts.push(self.over_seeds(Style::Text));
        }
        parts.extend(self.beside_the_paper(Style::Text));
        parts.join("\n")
    }

    /// The summary over seeds and the paper's figures as Markdown.
    pub fn markdown(&self) -> String {
        let mut parts = vec![self.over_seeds(Style::Markdown)];
        parts.extend(self.beside_the_paper(Style::Markdown));
        parts.join("\n")
    }

    fn over_seeds(&self, style: Style) -> String {
        let mut table = Table::new(&[
            ("task", Left),
            ("algorithm", Left),
            ("trained for", Right),
            ("seeds", Right),
            ("scored in", Left),
            ("last 3", Right),
            ("last 5", Right),
            ("last 50000 steps", Right),
            ("what differs from other runs of the task and algorithm", Left),
        ]);
        let cell = |value: Option<Spread>| value.map_or_else(|| "-".to_owned(), Spread::text_of_both);
        for g in &self.groups {
            let measure = if g.normalised { "" } else { " (returns)" };
            table.push([
                g.task.clone(),
                g.agent.clone(),
                g.steps_in_words(),
                g.seeds.len().to_string() + &g.goals.map(|goals| format!(", {goals} goals")).unwrap_or_default(),
                format!("{}{measure}", g.scored_in),
                cell(g.mean_last_3),
                cell(g.mean_last_5),
                cell(g.mean_last_50000_steps),
                g.differs.join(", "),
            ]);
        }
        let title = "Over seeds: mean ± standard deviation of the runs, divided by n - 1 (in parentheses: by n).";
        let mut text = format!("{title}\n\n{}", table.render(style));
        for group in &self.groups {
            text.extend(group.unfinished.iter().map(|run| format!("\nNot complete: {run}.\n")));
            text.extend(group.left_out.iter().map(|run| format!("\nNot counted: {run}.\n")));
        }
        text
    }

    /// For each task of the paper: what these runs score, what is published, and how the protocols differ.
    fn beside_the_paper(&self, style: Style) -> Vec<String> {
        let mut tasks: Vec<&str> = Vec::new();
        for group in self.groups.iter().filter(|group| !group.published.is_empty()) {
            if !tasks.contains(&&*group.task) {
                tasks.push(&group.task);
            }
        }
        tasks.into_iter().map(|task| self.task(task, style)).collect()
    }

    fn task(&self, task: &str, style: Style) -> String {
        let groups = || self.groups.iter().filter(|group| group.task == task);
        let mut table = Table::new(&[
            (task, Left),
            ("score", Right),
            ("± by n", Right),
            ("± by n - 1", Right),
            ("what stands behind it", Left),
        ]);
        let mut notes = String::from(
            "\nThe paper does not say how its ± is computed. DAC's code, on which its own is built, divides by the number of \
             seeds n.\n",
        );
        let number = |value: Option<f64>| value.map(|value| format!("{value:.2}")).unwrap_or_default();
        for g in groups() {
            let ours = format!("ours: {}", g.named());
            let mut row = |score: Option<Spread>, what: &str| {
                let [mean, by_n, by_one_less] =
                    [score.map(|s| s.mean), score.and_then(|s| s.population_std), score.and_then(|s| s.std)];
                let mean = mean.map_or_else(|| "-".to_owned(), |mean| number(Some(mean)));
                let behind = format!("{what}; {}", g.behind());
                table.push([ours.clone(), mean, number(by_n), number(by_one_less), behind]);
            };
            row(g.mean_last_5, "last 5 evaluations");
            if g.mean_last_50000_steps.is_some() && g.mean_last_50000_steps != g.mean_last_5 {
                row(g.mean_last_50000_steps, "last 50000 steps");
            }
            if !g.departures.is_empty() {
                let departures = g.departures.join("; ");
                notes += &format!("\nNot the paper's protocol ({ours}, {} steps): {departures}.\n", g.steps);
            }
            if let Some(goals) = g.goals {
                notes += &format!(
                    "\nAntMaze-v0 has one goal a run: {goals} behind this ± ({ours}), where D4RL's code asks for 50 to 100 \
                     seeds.\n"
                );
            }
        }
        for published in groups().next().into_iter().flat_map(|group| &group.published) {
            let printed = |value: f64| format!("{value:.1}");
            let (mean, std) = (printed(published.score.mean), published.score.std.map(printed).unwrap_or_default());
            table.push([published.method.to_owned(), mean, std, String::new(), published.source.to_owned()]);
        }
        table.render(style) + &notes
    }
}
