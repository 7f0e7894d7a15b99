//! The whole report: a table of each run, summaries over seeds, methods and tasks, and published
//! tables with ours beside them.

use std::collections::BTreeSet;
use std::fmt::Alignment::{Left, Right};
use std::io;
use std::path::{Path, PathBuf};

use quad_run::folder::walk;
use quad_run::results::{Ranking, RunReport, Select, Spread, published};
use quad_run::table::{Block, Style, Table};
use quad_runtime::one_line;
use serde::Serialize;
use tracing::warn;

use super::beside;
use super::seeds::{self, GroupReport};
use super::study::{self, Comparison, MethodReport};

/// What `learner report` says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Which evaluations of a run count.
    pub select: Select,
    /// Each folder.
    pub runs: Vec<RunReport>,
    /// The folders summarized over seeds.
    pub groups: Vec<GroupReport>,
    /// Each method over its tasks and seeds.
    pub study: Vec<MethodReport>,
    /// Each method against the first.
    pub comparisons: Vec<Comparison>,
    /// The folders that cannot be read, each with the reason.
    pub unreadable: Vec<String>,
    /// Folders of runs that were named themselves.
    #[serde(skip)]
    in_full: BTreeSet<PathBuf>,
}

impl Report {
    /// Reads run folders, and those below other folders. One that cannot be read keeps no other
    /// from being reported.
    ///
    /// # Errors
    /// None of them holds a run that can be read.
    pub fn read(paths: &[PathBuf], select: Select) -> anyhow::Result<Self> {
        let mut unreadable = Vec::new();
        let mut note = |dir: &Path, error: io::Error| {
            // A pattern like `runs/*` has other files, too.
            if !matches!(error.kind(), io::ErrorKind::NotADirectory | io::ErrorKind::NotFound) {
                unreadable.push(format!("cannot read {}: {error}", dir.display()));
            }
        };
        let (mut found, mut seen) = (Vec::new(), BTreeSet::new());
        for path in paths {
            let dirs = walk(path, &mut note);
            if dirs.is_empty() && paths.len() > 1 {
                warn!("there is no run in {}", path.display());
            }
            found.extend(dirs.into_iter().filter(|dir| seen.insert(dir.clone())));
        }
        let read = |dir: &PathBuf| {
            RunReport::read(dir).map_err(|error| unreadable.push(one_line(&error))).ok()
        };
        let runs: Vec<_> = found.iter().filter_map(read).collect();
        if runs.is_empty() {
            // What is wrong with the first, or that there is none.
            RunReport::read(found.first().unwrap_or(&paths[0]))?;
        }
        let groups = seeds::groups(&runs, select);
        let (study, comparisons) = study::study(&groups);
        let in_full = paths.iter().cloned().collect();
        Ok(Self { select, runs, groups, study, comparisons, unreadable, in_full })
    }

    /// Every part: a table of each run that was named itself, the summaries over seeds, methods and
    /// tasks if there are several runs, and published tables where they have these tasks. Other
    /// styles than text leave out the single runs.
    pub fn render(&self, style: Style) -> String {
        let mut parts = Vec::new();
        if style == Style::Text {
            let in_full = self
                .runs
                .iter()
                .filter(|run| self.runs.len() == 1 || self.in_full.contains(&run.dir));
            parts.extend(in_full.map(|run| Block::Text(self.table(run))));
        }
        parts.extend(self.summaries(style != Style::Text));
        parts.iter().map(|part| part.render(style)).collect::<Vec<_>>().join("\n")
    }

    /// The parts but for the tables of single runs; `with_one`: also the summary over seeds of a
    /// single run.
    pub fn summaries(&self, with_one: bool) -> Vec<Block> {
        let mut parts =
            Vec::from_iter(self.select.warning().map(|warning| Block::Text(warning.to_owned())));
        if self.runs.len() > 1 || with_one {
            parts.extend(self.over_seeds());
        }
        if self.runs.len() > 1 && !self.study.is_empty() {
            parts.extend(study::tables(&self.study, &self.comparisons));
        }
        let unreadable =
            self.unreadable.iter().map(|error| format!("Not in this report: {error}.\n"));
        parts.extend((!self.unreadable.is_empty()).then(|| Block::Text(unreadable.collect())));
        let judgments = self.runs.iter().flat_map(|run| run.judgments.iter().cloned());
        parts.extend(Ranking::of(judgments).iter().flat_map(Ranking::parts));
        parts.extend(
            published::all_tables()
                .into_iter()
                .flat_map(|name| beside::table(name, &self.groups, self.select)),
        );
        parts
    }

    fn table(&self, run: &RunReport) -> String {
        let best = run.best().filter(|_| self.select == Select::Best);
        let best = best.map(|best| {
            let (step, measure, mean) = (best.step, run.measure(), best.score.mean);
            format!("mean {measure} of the best evaluation, after {step} steps: {mean:.2}\n")
        });
        run.text() + &best.unwrap_or_default()
    }

    fn over_seeds(&self) -> Vec<Block> {
        let scores: &[_] = match self.select {
            Select::Last => &["last 3", "last 5", "last 50000 steps"],
            Select::Best => &["best evaluation"],
        };
        let texts = ["task", "algorithm"].map(|name| (name, Left));
        let numbers = ["trained for", "seeds"].map(|name| (name, Right));
        let mut header = Vec::from_iter(texts.into_iter().chain(numbers));
        header.push(("scored in", Left));
        header.extend(scores.iter().map(|name| (*name, Right)));
        header.push(("what differs from other runs of the task and algorithm", Left));
        let mut table = Table::new(&header);
        let cell =
            |value: Option<Spread>| value.map_or_else(|| "-".to_owned(), Spread::text_of_both);
        for g in &self.groups {
            let measure = if g.normalized { "" } else { " (returns)" };
            let mut row = vec![
                g.task.clone(),
                g.agent.clone(),
                g.steps_in_words(),
                g.seeds.len().to_string()
                    + &g.goals.map(|goals| format!(", {goals} goals")).unwrap_or_default(),
                format!("{}{measure}", g.scored_in),
            ];
            row.extend(match self.select {
                Select::Last => {
                    [g.mean_last_3, g.mean_last_5, g.mean_last_50000_steps].map(cell).to_vec()
                }
                Select::Best => vec![cell(g.best)],
            });
            row.push(g.differs.join(", "));
            table.push(row);
        }
        let title = "Over seeds: mean ± standard deviation of the runs, divided by n - 1 (in parentheses: by n).\n";
        let mut marked = Vec::new();
        for group in &self.groups {
            marked.extend(
                group
                    .unfinished
                    .iter()
                    .map(|run| format!("Not complete, and in no other figure: {run}.\n")),
            );
            marked.extend(group.left_out.iter().map(|run| format!("Not counted: {run}.\n")));
        }
        let mut parts = vec![Block::Text(title.to_owned()), Block::Table(table)];
        parts.extend((!marked.is_empty()).then(|| Block::Text(marked.concat())));
        parts
    }
}
