//! What runs achieved: their evaluations, summaries over seeds, and what is published for the same tasks.
//!
//! The protocol is the paper's (section 5.1 and appendix B): the score of a run is the mean of its last 5 evaluations, or of
//! those in its last 50,000 steps, never that of its best one; several seeds give mean ± standard deviation.
//!
//! [`run`] reads a run; [`seeds`] puts runs together that differ in their seed alone; [`published`] are the paper's
//! figures; [`table`] writes tables.

pub mod published;
pub mod run;
pub mod seeds;
pub mod table;

use std::fmt::Alignment::{Left, Right};
use std::path::PathBuf;

use serde::Serialize;

use crate::run::RunDirError;
pub use run::RunReport;
pub use seeds::GroupReport;
use table::{Style, Table, cell, spread};

/// Gradient steps at the end of a run over which the paper's appendix B takes the mean.
const FINAL_STEPS: u64 = 50_000;

/// Mean and sample standard deviation (n - 1).
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// The standard deviation; absent for a single value.
    pub std: Option<f64>,
}

impl Spread {
    /// Of some values; absent without any.
    pub fn of(values: &[f64]) -> Option<Self> {
        let count = values.len() as f64;
        if values.is_empty() {
            return None;
        }
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        let std = (values.len() > 1).then(|| (squares / (count - 1.0)).sqrt());
        Some(Self { mean, std })
    }
}

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
    pub fn read(paths: &[PathBuf]) -> Result<Self, RunDirError> {
        let runs: Vec<_> = paths.iter().map(|path| RunReport::read(path)).collect::<Result<_, _>>()?;
        Ok(Self { groups: seeds::groups(&runs), runs })
    }

    /// A table of each run; with several runs the summary over seeds; for tasks of the paper, its figures.
    pub fn text(&self) -> String {
        let mut parts: Vec<_> = self.runs.iter().map(RunReport::table).collect();
        if self.runs.len() > 1 {
            parts.push(format!(
                "Over seeds (mean ± standard deviation of the runs):\n\n{}",
                self.over_seeds(Style::Text)
            ));
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
        let mut table = Table::new([
            ("preset", Left),
            ("algorithm", Left),
            ("candidates", Right),
            ("steps", Right),
            ("seeds", Right),
            ("scored in", Left),
            ("last 3", Right),
            ("last 5", Right),
            ("last 50000 steps", Right),
            ("what differs from other runs of the preset", Left),
        ]);
        for g in &self.groups {
            let measure = if g.normalised { "" } else { " (returns)" };
            table.push([
                g.preset.clone(),
                g.agent.clone(),
                g.candidates.to_string(),
                g.steps.to_string(),
                g.seeds.len().to_string(),
                format!("{}{measure}", g.scored_in),
                cell(g.mean_last_3),
                cell(g.mean_last_5),
                cell(g.mean_last_50000_steps),
                g.differs.join(", "),
            ]);
        }
        let mut text = table.render(style);
        for left_out in self.groups.iter().flat_map(|group| &group.left_out) {
            text.push_str(&format!("\nNot counted: {left_out}.\n"));
        }
        text
    }

    /// For each task of the paper: what these runs score, what is published, and how the protocols differ.
    fn beside_the_paper(&self, style: Style) -> Vec<String> {
        let mut presets: Vec<&str> = Vec::new();
        for group in self.groups.iter().filter(|group| !group.published.is_empty()) {
            if !presets.contains(&&*group.preset) {
                presets.push(&group.preset);
            }
        }
        presets.into_iter().map(|preset| self.task(preset, style)).collect()
    }

    fn task(&self, preset: &str, style: Style) -> String {
        let groups = || self.groups.iter().filter(|group| group.preset == preset);
        let mut table = Table::new([(preset, Left), ("score", Right), ("what stands behind it", Left)]);
        let mut departures = String::new();
        for g in groups() {
            let ours = format!("ours: {}, {} candidates", g.variant, g.candidates);
            let behind = |what: &str| {
                let seeds = g.seeds.len();
                let plural = if seeds == 1 { "" } else { "s" };
                let (steps, device, scored_in) = (g.steps, g.device.name(), &g.scored_in);
                format!("{what}; {seeds} seed{plural}, {steps} steps on {device}, scored in {scored_in}")
            };
            table.push([ours.clone(), cell(g.mean_last_5), behind("last 5 evaluations")]);
            if g.mean_last_50000_steps.is_some() && g.mean_last_50000_steps != g.mean_last_5 {
                table.push([ours.clone(), cell(g.mean_last_50000_steps), behind("last 50000 steps")]);
            }
            if !g.departures.is_empty() {
                departures.push_str(&format!(
                    "\nNot the paper's protocol ({ours}, {} steps): {}.\n",
                    g.steps,
                    g.departures.join("; ")
                ));
            }
        }
        for published in groups().next().into_iter().flat_map(|group| &group.published) {
            table.push([published.method.to_owned(), spread(published.score, 1), published.source.to_owned()]);
        }
        table.render(style) + &departures
    }
}
