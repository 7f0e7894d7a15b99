//! The whole report: each run, aggregates over seeds, methods and tasks, and published tables.

use std::collections::BTreeSet;
use std::fmt::Alignment::{Left, Right};
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};

use quad_run::folder::walk;
use quad_run::results::{Ranking, RunReport, Select, Spread, published::all_tables};
use quad_run::table::{Block, Column, Style, Table};
use quad_runtime::one_line;
use serde::Serialize;
use tracing::warn;

use super::groups::{self, GroupReport};
use super::methods::{self, Comparison, MethodReport};
use super::published;

#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    pub select: Select,
    pub runs: Vec<RunReport>,
    pub groups: Vec<GroupReport>,
    /// Each method over its tasks and seeds.
    pub study: Vec<MethodReport>,
    /// Each method against the first.
    pub comparisons: Vec<Comparison>,
    /// Folders that cannot be read, and why.
    pub unreadable: Vec<String>,
    /// Folders that were named themselves.
    #[serde(skip)]
    named: BTreeSet<PathBuf>,
}

impl Report {
    /// Reads the runs in and below these folders. Fails only if none of them can be read.
    pub fn read(paths: &[PathBuf], select: Select) -> anyhow::Result<Self> {
        let mut unreadable = Vec::new();
        let mut note = |dir: &Path, error: Error| {
            // A pattern like `runs/*` matches other files, too.
            if !matches!(error.kind(), ErrorKind::NotADirectory | ErrorKind::NotFound) {
                unreadable.push(format!("cannot read {}: {error}", dir.display()));
            }
        };
        let (mut dirs, mut seen) = (Vec::new(), BTreeSet::new());
        for path in paths {
            let below = walk(path, &mut note);
            if below.is_empty() && paths.len() > 1 {
                warn!("there is no run in {}", path.display());
            }
            dirs.extend(below.into_iter().filter(|dir| seen.insert(dir.clone())));
        }
        let mut runs = Vec::new();
        for dir in &dirs {
            match RunReport::read(dir) {
                Ok(run) => runs.push(run),
                Err(error) => unreadable.push(one_line(&error)),
            }
        }
        if runs.is_empty() {
            // Fails with the reason.
            RunReport::read(dirs.first().unwrap_or(&paths[0]))?;
        }
        groups::tell_apart(&mut runs);
        let groups = groups::groups(&runs, select);
        let (study, comparisons) = methods::aggregate(&groups);
        let named = paths.iter().cloned().collect();
        Ok(Self { select, runs, groups, study, comparisons, unreadable, named })
    }

    /// All tables; those of single runs only as text, of a single run or of those that were named
    /// themselves.
    pub fn render(&self, style: Style) -> String {
        let mut blocks = Vec::new();
        for run in self.runs.iter().filter(|_| style == Style::Text) {
            if self.runs.len() == 1 || self.named.contains(&run.dir) {
                blocks.push(Block::Text(self.table(run)));
            }
        }
        blocks.extend(self.summaries(style != Style::Text));
        let blocks = blocks.iter().map(|block| block.render(style));
        Vec::from_iter(blocks).join("\n")
    }

    /// All tables but those of single runs. `single`: also aggregates the seeds of a single run.
    pub fn summaries(&self, single: bool) -> Vec<Block> {
        let paragraph = |text: String| (!text.is_empty()).then_some(Block::Text(text));
        let warning = self.select.warning().unwrap_or_default();
        let mut blocks = Vec::from_iter(paragraph(warning.to_owned()));
        if self.runs.len() > 1 || single {
            blocks.extend(self.over_seeds());
            blocks.extend(paragraph(self.not_counted()));
        }
        if self.runs.len() > 1 && !self.study.is_empty() {
            blocks.extend(methods::tables(&self.study, &self.comparisons));
        }
        let missing = |reason: &String| format!("Not in this report: {reason}.\n");
        blocks.extend(paragraph(self.unreadable.iter().map(missing).collect()));
        let judgments = self.runs.iter().flat_map(|run| &run.judgments);
        blocks.extend(Ranking::from_judgments(judgments.cloned()).iter().flat_map(Ranking::blocks));
        for name in all_tables() {
            blocks.extend(published::table(name, &self.groups, self.select));
        }
        blocks
    }

    fn table(&self, run: &RunReport) -> String {
        let mut text = run.text();
        if let (Select::Best, Some(best)) = (self.select, run.best()) {
            let (step, measure, mean) = (best.step, run.measure(), best.score.mean);
            text +=
                &format!("mean {measure} of the best evaluation, after {step} steps: {mean:.2}\n");
        }
        text
    }

    fn over_seeds(&self) -> [Block; 2] {
        fn spread(value: Option<Spread>) -> String {
            value.map_or("-".to_owned(), Spread::text_with_population)
        }
        let mut columns: Vec<Column<GroupReport>> = vec![
            ("task", Left, |group| group.task.clone()),
            ("algorithm", Left, |group| group.agent.clone()),
            ("trained for", Right, GroupReport::steps_in_words),
            ("seeds", Right, |group| {
                let goals = group.goals.map(|goals| format!(", {goals} goals"));
                group.seeds.len().to_string() + &goals.unwrap_or_default()
            }),
            ("scored in", Left, |group| {
                let unit = (!group.normalized).then(|| format!(" ({}s)", group.measure()));
                group.scored_in.clone() + &unit.unwrap_or_default()
            }),
        ];
        match self.select {
            Select::Last => columns.extend::<[Column<GroupReport>; 3]>([
                ("last 3", Right, |group| spread(group.mean_last_3)),
                ("last 5", Right, |group| spread(group.mean_last_5)),
                ("last 50000 steps", Right, |group| spread(group.mean_last_50000_steps)),
            ]),
            Select::Best => columns.push(("best evaluation", Right, |group| spread(group.best))),
        }
        let differs = "what differs from other runs of the task and algorithm";
        columns.push((differs, Left, |group| group.differs.join(", ")));
        let title = "Over seeds: mean ± standard deviation of the runs, divided by n - 1 (in parentheses: by n).\n";
        let table = Table::from_rows(&self.groups, &columns);
        [Block::Text(title.to_owned()), Block::Table(table)]
    }

    fn not_counted(&self) -> String {
        let mut text = String::new();
        for group in &self.groups {
            for run in &group.unfinished {
                text += &format!("Not complete, and in no other figure: {run}.\n");
            }
            for run in &group.left_out {
                text += &format!("Not counted: {run}.\n");
            }
        }
        text
    }
}
