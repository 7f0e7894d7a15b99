//! The scores of policies, and their table.

use std::collections::BTreeSet;
use std::fmt::Alignment::{Left, Right};
use std::path::PathBuf;

use quad_policy::Choice;
use quad_run::results::Spread;
use quad_run::table::{Style, Table};
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
    /// Episodes in the order of their seeds.
    pub episodes: Vec<EpisodeOutcome>,
}

impl Scored {
    /// How the policy chose, as text.
    pub fn title(&self) -> String {
        self.choice.map_or_else(|| "no candidates".to_owned(), |choice| choice.to_string())
    }

    /// The normalized scores of the episodes, of which there is at least one.
    pub fn spread(&self) -> Option<Spread> {
        Spread::of(&Vec::from_iter(self.episodes.iter().map(|episode| episode.score)))
    }
}

/// A row for each snapshot, a column for each way to choose; below, their means if averaging makes
/// sense.
pub fn table(scored: &[Scored]) -> String {
    let mut titles: Vec<String> = Vec::new();
    for title in scored.iter().map(Scored::title) {
        if !titles.contains(&title) {
            titles.push(title);
        }
    }
    let head = [("snapshot", Left), ("step", Right), ("environment", Right), ("episodes", Right)];
    let choices = titles.iter().map(|title| (title.as_str(), Right));
    let mut table = Table::new(&Vec::from_iter(head.into_iter().chain(choices)));
    let text = |spread: Option<Spread>| spread.map(Spread::text).unwrap_or_default();

    let snapshots: Vec<&[Scored]> =
        scored.chunk_by(|one, next| one.snapshot == next.snapshot).collect();
    for of_one in &snapshots {
        let Scored { snapshot, step, environment, episodes, .. } = &of_one[0];
        let head = [
            snapshot.display().to_string(),
            step.to_string(),
            environment.clone(),
            episodes.len().to_string(),
        ];
        let score = |title: &String| {
            let found = of_one.iter().find(|scored| scored.title() == *title);
            text(found.and_then(Scored::spread))
        };
        table.push(Vec::from_iter(head.into_iter().chain(titles.iter().map(score))));
    }
    let precisions: BTreeSet<&str> =
        scored.iter().map(|scored| scored.precision.as_str()).collect();
    let precisions = Vec::from_iter(precisions).join(" and ");
    let mut note =
        format!("normalized score in {precisions}, mean ± standard deviation over the episodes");
    if snapshots.len() > 1 && scored.iter().all(|other| other.environment == scored[0].environment)
    {
        let head = [
            format!("mean of {} snapshots", snapshots.len()),
            String::new(),
            String::new(),
            String::new(),
        ];
        let mean = |title: &String| {
            let with_these = scored.iter().filter(|scored| scored.title() == *title);
            let means =
                Vec::from_iter(with_these.filter_map(Scored::spread).map(|spread| spread.mean));
            // A mean over fewer snapshots would not be what the row says.
            text(Spread::of(&means).filter(|_| means.len() == snapshots.len()))
        };
        table.push(Vec::from_iter(head.into_iter().chain(titles.iter().map(mean))));
        note.push_str("; in the last row over the snapshots");
    }
    table.render(Style::Text) + &note
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn scored(snapshot: &str, candidates: u32, scores: &[f64]) -> Scored {
        let episode =
            |&score| EpisodeOutcome { index: 0, seed: 1, episode_return: 0.0, length: 7, score };
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
        let table = table(&[
            scored("a", 1, &[1.0, 3.0]),
            scored("a", 10, &[10.0, 10.0]),
            scored("longer", 1, &[4.0, 4.0]),
        ]);
        let lines: Vec<Vec<&str>> = table
            .lines()
            .map(|line| line.split("  ").filter(|cell| !cell.is_empty()).map(str::trim).collect())
            .collect();
        assert_eq!(
            lines[0],
            ["snapshot", "step", "environment", "episodes", "1 candidate", "10 candidates"]
        );
        assert_eq!(lines[1], ["a", "20", "hopper", "2", "2.00 ± 1.41", "10.00 ± 0.00"]);
        assert_eq!(lines[2], ["longer", "20", "hopper", "2", "4.00 ± 0.00"]);
        assert_eq!(
            lines[3],
            ["mean of 2 snapshots", "3.00 ± 1.41"],
            "ten candidates were not tried for both"
        );
    }

    #[test]
    fn unlike_environments_have_no_mean_and_every_arithmetic_is_named() {
        let gaussian =
            Scored { choice: None, environment: "walker2d".to_owned(), ..scored("a", 1, &[1.0]) };
        let diffusion = Scored { precision: "bf16-amx".to_owned(), ..scored("b", 10, &[1.0]) };
        let table = table(&[gaussian, diffusion]);
        assert!(!table.contains("mean of"), "{table}");
        assert!(
            table.contains("no candidates  10 candidates")
                && table.contains("bf16-amx and f32-avx2"),
            "{table}"
        );
        assert!(table.contains(" 1.00\n"), "a single episode has no spread: {table}");
    }
}
