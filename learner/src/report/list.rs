//! All runs below some folders, a line each.

use std::fmt;
use std::fmt::Alignment::{Left, Right};
use std::fs;
use std::path::{Path, PathBuf};

use indicatif::HumanBytes;
use serde::Serialize;

use super::run::RunReport;
use super::state::State;
use super::summary::walk;
use super::table::{Style, Table};
use crate::run::RunDir;

/// What is listed.
pub struct Listing {
    /// Runs and what cannot be read, in the order of their folders.
    pub entries: Vec<Entry>,
}

/// A folder.
#[derive(Serialize)]
pub struct Entry {
    /// Its path below the folder that was asked for, or its whole path if several were.
    pub name: String,
    /// The folder.
    pub dir: PathBuf,
    #[serde(flatten)]
    found: Found,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Found {
    Run(Box<Listed>),
    Unreadable {
        /// Why, in one line.
        error: String,
    },
}

/// A run.
#[derive(Serialize)]
struct Listed {
    task: String,
    algorithm: String,
    /// As in [`RunReport::variant`].
    variant: String,
    seed: u64,
    /// Gradient steps done, of so many.
    step: u64,
    steps: u64,
    /// How far it is, in words.
    state: String,
    complete: bool,
    /// Whether a learner has it open.
    at_work: bool,
    /// The last complete evaluation: its gradient step and mean score.
    score_step: Option<u64>,
    score: Option<f64>,
    /// Of all files in the folder.
    bytes: u64,
}

impl Listing {
    /// Reads all runs in and below these folders.
    pub fn read(dirs: &[PathBuf]) -> Self {
        let mut entries = Vec::new();
        for dir in dirs {
            let entry = |path: &Path, found: anyhow::Result<Listed>| {
                let below = path.strip_prefix(dir).ok().filter(|below| dirs.len() == 1 && *below != Path::new(""));
                let found = found.map_or_else(
                    |error| Found::Unreadable { error: format!("{error:#}").replace('\n', " ") },
                    |listed| Found::Run(Box::new(listed)),
                );
                Entry { name: below.unwrap_or(path).display().to_string(), dir: path.to_owned(), found }
            };
            let mut unreadable = Vec::new();
            let runs = walk(dir, &mut |path, error| unreadable.push(entry(path, Err(error.into()))));
            entries.extend(runs.iter().map(|path| entry(path, Listed::read(path))));
            entries.extend(unreadable);
        }
        Self { entries }
    }
}

impl fmt::Display for Listing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let header =
            [("run", Left), ("task", Left), ("method", Left), ("state", Left), ("last score", Right), ("size", Right)];
        let mut table = Table::new(&header);
        let mut unreadable = String::new();
        for Entry { name, found, .. } in &self.entries {
            match found {
                Found::Run(run) => table.push([
                    name.clone(),
                    run.task.clone(),
                    run.method(),
                    run.state(),
                    run.score(),
                    HumanBytes(run.bytes).to_string(),
                ]),
                Found::Unreadable { error } => unreadable += &format!("{name}: {error}\n"),
            }
        }
        let runs = if table.is_empty() { "no runs\n".to_owned() } else { table.render(Style::Text) };
        write!(f, "{runs}{unreadable}")
    }
}

impl Listed {
    fn read(path: &Path) -> anyhow::Result<Self> {
        let report = RunReport::scored(path)?;
        let state = State::of(&report)?;
        let newest = report.newest();
        Ok(Self {
            step: state.step(report.steps),
            steps: report.steps,
            state: state.text(report.steps),
            complete: state == State::Complete,
            at_work: RunDir::at(path).is_in_use(),
            score_step: newest.map(|newest| newest.step),
            score: newest.map(|newest| newest.score.mean),
            bytes: size(path),
            task: report.task,
            algorithm: report.algorithm,
            variant: report.variant,
            seed: report.seed,
        })
    }

    fn method(&self) -> String {
        let Self { algorithm, variant, .. } = self;
        if algorithm == variant { algorithm.clone() } else { format!("{algorithm}, {variant}") }
    }

    fn state(&self) -> String {
        format!("{}{}", self.state, if self.at_work { ", at work" } else { "" })
    }

    fn score(&self) -> String {
        let score = self.score.zip(self.score_step);
        score.map_or("-".to_owned(), |(score, step)| format!("{score:.1} @{step}"))
    }
}

/// Bytes of all files in a folder.
fn size(path: &Path) -> u64 {
    let entries = fs::read_dir(path).into_iter().flatten().flatten();
    let of = |entry: fs::DirEntry| {
        let metadata = entry.metadata().ok()?;
        Some(if metadata.is_dir() { size(&entry.path()) } else { metadata.len() })
    };
    entries.filter_map(of).sum()
}
