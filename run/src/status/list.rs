//! A list of the runs below some folders.

use std::error::Error;
use std::fmt::Alignment::{Left, Right};
use std::fs::{self, DirEntry};
use std::path::{Path, PathBuf};

use indicatif::HumanBytes;
use quad_runtime::one_line;
use serde::Serialize;

use super::State;
use crate::folder::{RunDir, RunDirError, walk};
use crate::results::RunReport;
use crate::table::{Style, Table};

/// A run, or a folder that cannot be read.
#[derive(Serialize)]
pub struct Entry {
    /// Path below the listed folder; the whole path if several folders are listed.
    pub name: String,
    /// Path of the folder.
    pub dir: PathBuf,
    #[serde(flatten)]
    run: Option<Listed>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

#[derive(Serialize)]
struct Listed {
    task: String,
    /// Algorithm and variant.
    method: String,
    /// Gradient steps done.
    step: u64,
    steps: u64,
    state: String,
    /// True if a learner is at work.
    at_work: bool,
    /// Gradient step and mean score of the last complete evaluation.
    score_step: Option<u64>,
    score: Option<f64>,
    /// Total size of the files.
    bytes: u64,
}

/// Lists all runs at and below these folders.
pub fn list(dirs: &[PathBuf]) -> Vec<Entry> {
    let mut entries = Vec::new();
    for asked in dirs {
        let mut add = |dir: &Path, run: Option<Listed>, error: Option<&dyn Error>| {
            let below = dir.strip_prefix(asked).ok();
            let below = below.filter(|below| dirs.len() == 1 && *below != Path::new(""));
            let name = below.unwrap_or(dir).display().to_string();
            let error = error.map(|error| one_line(error).replace('\n', " "));
            let dir = dir.to_owned();
            entries.push(Entry { name, dir, run, error });
        };
        let runs = walk(asked, &mut |dir, error| add(dir, None, Some(&error)));
        for dir in runs {
            match Listed::read(&dir) {
                Ok(run) => add(&dir, Some(run), None),
                Err(error) => add(&dir, None, Some(&error)),
            }
        }
    }
    entries
}

/// The readable runs as a table.
pub fn table(entries: &[Entry]) -> String {
    let texts = ["run", "task", "method", "state"].map(|name| (name, Left));
    let mut table = Table::new(&[&texts[..], &[("last score", Right), ("size", Right)]].concat());
    for Entry { name, run, .. } in entries {
        let Some(run) = run else { continue };
        let at_work = if run.at_work { ", at work" } else { "" };
        let state = format!("{}{at_work}", run.state);
        let score = run.score.zip(run.score_step);
        let score = score.map_or("-".to_owned(), |(score, step)| format!("{score:.1} @{step}"));
        let size = HumanBytes(run.bytes).to_string();
        let (task, method) = (run.task.clone(), run.method.clone());
        table.push([name.clone(), task, method, state, score, size]);
    }
    table.render(Style::Text)
}

impl Entry {
    /// Name and error of a folder that cannot be read.
    pub fn unreadable(&self) -> Option<String> {
        self.error.as_ref().map(|error| format!("{}: {error}", self.name))
    }
}

impl Listed {
    fn read(dir: &Path) -> Result<Self, RunDirError> {
        let report = RunReport::scored(dir)?;
        let (state, newest) = (State::from_report(&report)?, report.newest());
        let mut method = report.algorithm.clone();
        if report.variant != method {
            method += &format!(", {}", report.variant);
        }
        Ok(Self {
            method,
            step: state.step(report.steps),
            steps: report.steps,
            state: state.text(report.steps),
            at_work: RunDir::at(dir).is_in_use(),
            score_step: newest.map(|newest| newest.step),
            score: newest.map(|newest| newest.score.mean),
            bytes: size(dir),
            task: report.task,
        })
    }
}

/// Total size of the files in a folder, bytes.
fn size(dir: &Path) -> u64 {
    let bytes = |entry: DirEntry| match entry.metadata() {
        Ok(metadata) if metadata.is_dir() => size(&entry.path()),
        metadata => metadata.map_or(0, |metadata| metadata.len()),
    };
    let entries = fs::read_dir(dir).into_iter().flatten();
    entries.flatten().map(bytes).sum()
}
