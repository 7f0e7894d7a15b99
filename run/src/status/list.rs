//! All runs below some folders, a line each.

use std::fmt::Alignment::{Left, Right};
use std::fs::{self, DirEntry};
use std::path::{Path, PathBuf};

use indicatif::HumanBytes;
use serde::Serialize;

use super::state::State;
use crate::results::RunReport;
use crate::run::{RunDir, walk};
use crate::table::{Style, Table};

/// A folder: a run, or what keeps it from being read.
#[derive(Serialize)]
pub struct Entry {
    /// Its path below the folder that was asked for, or its whole path if several were.
    pub name: String,
    /// The folder.
    pub dir: PathBuf,
    #[serde(flatten)]
    run: Option<Listed>,
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

#[derive(Serialize)]
struct Listed {
    task: String,
    /// The algorithm, and its variant if it has several.
    method: String,
    /// Gradient steps done, of so many.
    step: u64,
    steps: u64,
    /// How far it is, in words.
    state: String,
    /// Whether a learner has it open.
    at_work: bool,
    /// The last complete evaluation: its gradient step and mean score.
    score_step: Option<u64>,
    score: Option<f64>,
    /// Size of all files in the folder, bytes.
    bytes: u64,
}

/// All runs in and below these folders.
pub fn list(dirs: &[PathBuf]) -> Vec<Entry> {
    let mut entries = Vec::new();
    for asked in dirs {
        let mut add = |dir: &Path, found: anyhow::Result<Listed>| {
            let below = dir
                .strip_prefix(asked)
                .ok()
                .filter(|below| dirs.len() == 1 && *below != Path::new(""));
            let error = found.as_ref().err().map(|error| format!("{error:#}").replace('\n', " "));
            let name = below.unwrap_or(dir).display().to_string();
            entries.push(Entry { name, dir: dir.to_owned(), run: found.ok(), error });
        };
        let runs = walk(asked, &mut |dir, error| add(dir, Err(error.into())));
        runs.iter().for_each(|dir| add(dir, Listed::read(dir)));
    }
    entries
}

/// The runs that can be read, as a table for people.
pub fn table(entries: &[Entry]) -> String {
    let texts = ["run", "task", "method", "state"].map(|name| (name, Left));
    let mut table = Table::new(&[&texts[..], &[("last score", Right), ("size", Right)]].concat());
    for Entry { name, run, .. } in entries {
        let Some(run) = run else { continue };
        let state = format!("{}{}", run.state, if run.at_work { ", at work" } else { "" });
        let score = run.score.zip(run.score_step);
        let score = score.map_or("-".to_owned(), |(score, step)| format!("{score:.1} @{step}"));
        let size = HumanBytes(run.bytes).to_string();
        table.push([name.clone(), run.task.clone(), run.method.clone(), state, score, size]);
    }
    table.render(Style::Text)
}

impl Entry {
    /// The name of the folder and why it cannot be read, if it cannot.
    pub fn unreadable(&self) -> Option<String> {
        self.error.as_ref().map(|error| format!("{}: {error}", self.name))
    }
}

impl Listed {
    fn read(dir: &Path) -> anyhow::Result<Self> {
        let report = RunReport::scored(dir)?;
        let (state, newest) = (State::of(&report)?, report.newest());
        let variant = Some(&report.variant).filter(|variant| **variant != report.algorithm);
        Ok(Self {
            method: report.algorithm.clone()
                + &variant.map(|variant| format!(", {variant}")).unwrap_or_default(),
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

/// Bytes of all files in a folder.
fn size(dir: &Path) -> u64 {
    let of = |entry: DirEntry| match entry.metadata() {
        Ok(metadata) if metadata.is_dir() => size(&entry.path()),
        metadata => metadata.map_or(0, |metadata| metadata.len()),
    };
    fs::read_dir(dir).into_iter().flatten().flatten().map(of).sum()
}
