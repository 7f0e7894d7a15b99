//! The scores of policies, and their table.

use std::collections::BTreeSet;
use std::fmt;
use std::path::PathBuf;

use quad_policy::Choice;
use serde::Serialize;

use crate::sim::EpisodeOutcome;

/// The results of one policy with one way to choose.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scored {
    /// The file.
    pub snapshot: PathBuf,
    /// BLAKE3 of the file.
    pub weights: String,
    /// Environment of the episodes.
    pub environment: String,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Seed from which, with the step, the episodes' seeds follow.
    pub seed: u64,
    /// How the policy chose among its candidates; absent if it draws none.
    pub choice: Option<Choice>,
    /// Arithmetic of its actions, as in `scores.jsonl`.
    pub precision: String,
    /// In the order of their seeds.
    pub episodes: Vec<Episode>,
}

/// The result of one episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Episode {
    /// Seed of its initial state and of the policy's noise.
    pub seed: u64,
    /// Sum of its rewards, undiscounted.
    #[serde(rename = "return")]
    pub episode_return: f64,
    /// Its environment steps.
    pub length: u32,
    /// D4RL's normalised score.
    pub score: f64,
}

impl Scored {
    /// How the policy chose, as text.
    pub fn title(&self) -> String {
        self.choice.map_or_else(|| "no candidates".to_owned(), |choice| choice.to_string())
    }

    /// The normalised score of each episode.
    pub fn scores(&self) -> Vec<f64> {
        self.episodes.iter().map(|episode| episode.score).collect()
    }
}

impl From<&EpisodeOutcome> for Episode {
    fn from(outcome: &EpisodeOutcome) -> Self {
        let EpisodeOutcome { seed, episode_return, length, score, .. } = *outcome;
        Self { seed, episode_return, length, score }
    }
}

/// Mean and sample standard deviation (n - 1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// The mean; NaN for no value.
    pub mean: f64,
    /// The standard deviation; absent for a single value.
    pub std: Option<f64>,
}

impl Spread {
    /// The summary of these values.
    pub fn of(values: &[f64]) -> Self {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
        Self { mean, std: (values.len() > 1).then(|| (squares / (count - 1.0)).sqrt()) }
    }
}

impl fmt::Display for Spread {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.std {
            Some(std) => write!(f, "{:.2} ± {std:.2}", self.mean),
            None => write!(f, "{:.2}", self.mean),
        }
    }
}

/// A row for each snapshot, a column for each way to choose; below, their means if averaging makes sense.
pub fn table(scored: &[Scored]) -> String {
    let mut titles: Vec<String> = Vec::new();
    for title in scored.iter().map(Scored::title) {
        if !titles.contains(&title) {
            titles.push(title);
        }
    }
    let head = ["snapshot", "step", "environment", "episodes"].map(str::to_owned);
    let mut rows: Vec<Vec<String>> = vec![head.into_iter().chain(titles.iter().cloned()).collect()];

    let snapshots: Vec<&[Scored]> = scored.chunk_by(|one, next| one.snapshot == next.snapshot).collect();
    for of_one in &snapshots {
        let Scored { snapshot, step, environment, episodes, .. } = &of_one[0];
        let head = [snapshot.display().to_string(), step.to_string(), environment.clone(), episodes.len().to_string()];
        let score = |title: &String| {
            let found = of_one.iter().find(|scored| scored.title() == *title);
            found.map(|scored| Spread::of(&scored.scores()).to_string()).unwrap_or_default()
        };
        rows.push(head.into_iter().chain(titles.iter().map(score)).collect());
    }
    let precisions: BTreeSet<&str> = scored.iter().map(|scored| scored.precision.as_str()).collect();
    let precisions = Vec::from_iter(precisions).join(" and ");
    let mut note = format!("normalised score in {precisions}, mean ± standard deviation over the episodes");
    if snapshots.len() > 1 && scored.iter().all(|other| other.environment == scored[0].environment) {
        let head = [format!("mean of {} snapshots", snapshots.len()), String::new(), String::new(), String::new()];
        let mean = |title: &String| {
            let with_these = scored.iter().filter(|scored| scored.title() == *title);
            let means: Vec<f64> = with_these.map(|scored| Spread::of(&scored.scores()).mean).collect();
            // A mean over fewer snapshots would not be what the row says.
            if means.len() == snapshots.len() { Spread::of(&means).to_string() } else { String::new() }
        };
        rows.push(head.into_iter().chain(titles.iter().map(mean)).collect());
        note.push_str("; in the last row over the snapshots");
    }
    aligned(&rows) + &note
}

/// Makes columns as wide as needed: text to the left, numbers (in all columns but the first) to the right.
fn aligned(rows: &[Vec<String>]) -> String {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..rows.first().map_or(0, Vec::len)).map(width).collect();
    let line = |row: &Vec<String>| {
        let cells = row.iter().zip(&widths).enumerate().map(|(column, (cell, &width))| match column {
            0 => format!("{cell:<width$}"),
            _ => format!("  {cell:>width$}"),
        });
        format!("{}\n", cells.collect::<String>().trim_end())
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn scored(snapshot: &str, candidates: u32, scores: &[f64]) -> Scored {
        let episode = |&score| Episode { seed: 1, episode_return: 0.0, length: 7, score };
        Scored {
            snapshot: Path::new(snapshot).to_owned(),
            weights: String::new(),
            environment: "hopper".to_owned(),
            step: 20,
            seed: 1,
            choice: Some(Choice::best_of(candidates)),
            precision: "f32-avx2".to_owned(),
            episodes: scores.iter().map(episode).collect(),
        }
    }

    #[test]
    fn a_row_for_each_snapshot_and_a_column_for_each_way_to_choose() {
        let table =
            table(&[scored("a", 1, &[1.0, 3.0]), scored("a", 10, &[10.0, 10.0]), scored("longer", 1, &[4.0, 4.0])]);
        let lines: Vec<Vec<&str>> = table
            .lines()
            .map(|line| line.split("  ").filter(|cell| !cell.is_empty()).map(str::trim).collect())
            .collect();
        assert_eq!(lines[0], ["snapshot", "step", "environment", "episodes", "1 candidate", "10 candidates"]);
        assert_eq!(lines[1], ["a", "20", "hopper", "2", "2.00 ± 1.41", "10.00 ± 0.00"]);
        assert_eq!(lines[2], ["longer", "20", "hopper", "2", "4.00 ± 0.00"]);
        assert_eq!(lines[3], ["mean of 2 snapshots", "3.00 ± 1.41"], "ten candidates were not tried for both");
    }

    #[test]
    fn unlike_environments_have_no_mean() {
        let other = Scored { environment: "walker2d".to_owned(), ..scored("b", 1, &[1.0]) };
        let table = table(&[scored("a", 1, &[1.0]), other]);
        assert!(!table.contains("mean of"), "{table}");
        assert!(table.contains(" 1.00\n"), "a single episode has no spread: {table}");
    }

    #[test]
    fn every_arithmetic_is_named() {
        let gaussian = Scored { choice: None, precision: "f32-avx2".to_owned(), ..scored("a", 1, &[1.0]) };
        let diffusion = Scored { precision: "bf16-amx".to_owned(), ..scored("b", 10, &[1.0]) };
        let table = table(&[gaussian, diffusion]);
        assert!(table.contains("no candidates  10 candidates") && table.contains("bf16-amx and f32-avx2"), "{table}");
    }
}
