//! The scores of policies, and their table.

use std::collections::BTreeSet;
use std::fmt::Alignment::{Left, Right};

use quad_policy::Choice;
use quad_protocol::EpisodeScore;
use quad_run::results::Spread;
use quad_run::table::{Style, Table};
use serde::Serialize;

/// The results of one policy with one way to choose.
#[derive(Serialize)]
pub struct Scored {
    /// Path of the file.
    pub snapshot: String,
    /// BLAKE3 of the file.
    pub weights: String,
    pub environment: String,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Seed from which, with the step, the episodes' seeds follow.
    pub seed: u64,
    /// Absent if the policy draws no candidates.
    pub choice: Option<Choice>,
    /// Arithmetic of its actions, as in `scores.jsonl`.
    pub precision: String,
    /// In the order of their seeds.
    pub episodes: Vec<EpisodeScore>,
}

impl Scored {
    pub fn title(&self) -> String {
        title(self.choice)
    }

    /// Spread of the normalized scores.
    pub fn spread(&self) -> Option<Spread> {
        let scores = self.episodes.iter().map(|episode| episode.score);
        Spread::new(&Vec::from_iter(scores))
    }
}

/// A way to choose, as text.
pub fn title(choice: Option<Choice>) -> String {
    choice.map_or_else(|| "no candidates".to_owned(), |choice| choice.to_string())
}

/// A row per snapshot, a column per way to choose; below, their means if all snapshots have one
/// environment.
pub fn table(scored: &[Scored]) -> String {
    let mut titles: Vec<String> = Vec::new();
    for title in scored.iter().map(Scored::title) {
        if !titles.contains(&title) {
            titles.push(title);
        }
    }
    let head = ["snapshot", "step", "environment", "episodes"];
    let names = head.into_iter().chain(titles.iter().map(String::as_str));
    let mut columns = Vec::from_iter(names.map(|name| (name, Right)));
    columns[0].1 = Left;
    let mut table = Table::new(&columns);
    let text = |spread: Option<Spread>| spread.map(Spread::text).unwrap_or_default();

    let snapshots = Vec::from_iter(scored.chunk_by(|one, next| one.snapshot == next.snapshot));
    for choices in &snapshots {
        let Scored { snapshot, step, environment, episodes, .. } = &choices[0];
        let mut row = vec![snapshot.clone(), step.to_string()];
        row.extend([environment.clone(), episodes.len().to_string()]);
        row.extend(titles.iter().map(|title| {
            let scored = choices.iter().find(|scored| scored.title() == *title);
            text(scored.and_then(Scored::spread))
        }));
        table.push(row);
    }
    let precisions = scored.iter().map(|scored| scored.precision.as_str());
    let precisions = Vec::from_iter(BTreeSet::from_iter(precisions)).join(" and ");
    let mut note =
        format!("normalized score in {precisions}, mean ± standard deviation over the episodes");
    let mut environments = scored.chunk_by(|one, next| one.environment == next.environment);
    if snapshots.len() > 1 && environments.nth(1).is_none() {
        let mut row = vec![String::new(); head.len()];
        row[0] = format!("mean of {} snapshots", snapshots.len());
        row.extend(titles.iter().map(|title| {
            let titled = scored.iter().filter(|scored| scored.title() == *title);
            let means = Vec::from_iter(titled.filter_map(|scored| Some(scored.spread()?.mean)));
            // A mean over fewer snapshots would be another number than the others in the row.
            text(Spread::new(&means).filter(|_| means.len() == snapshots.len()))
        }));
        table.push(row);
        note.push_str("; in the last row over the snapshots");
    }
    table.render(Style::Text) + &note
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scored(snapshot: &str, candidates: u32, scores: &[f64]) -> Scored {
        let (seed, length, episode_return) = (1, 7, 0.0);
        let episode = |&score| EpisodeScore { seed, episode_return, length, score };
        Scored {
            snapshot: snapshot.into(),
            weights: String::new(),
            environment: "hopper".to_owned(),
            step: 20,
            seed,
            choice: Some(Choice::best_of(candidates)),
            precision: "f32-avx2".to_owned(),
            episodes: scores.iter().map(episode).collect(),
        }
    }

    #[test]
    fn has_a_row_per_snapshot_a_column_per_way_to_choose_and_a_mean_of_one_environment() {
        let (one, ten) = (scored("a", 1, &[1.0, 3.0]), scored("a", 10, &[10.0, 10.0]));
        let longer = scored("longer", 1, &[4.0, 4.0]);
        let cells = |line: &str| {
            let cells = line.split("  ").map(str::trim);
            Vec::from_iter(cells.filter(|cell| !cell.is_empty())).join("|")
        };
        // Ten candidates were not tried for both, so they have no mean.
        let expected = [
            "snapshot|step|environment|episodes|1 candidate|10 candidates",
            "a|20|hopper|2|2.00 ± 1.41|10.00 ± 0.00",
            "longer|20|hopper|2|4.00 ± 0.00",
            "mean of 2 snapshots|3.00 ± 1.41",
        ];
        let table = super::table(&[one, ten, longer]);
        assert!(table.lines().map(cells).take(4).eq(expected), "{table}");

        let mut gaussian = scored("a", 1, &[1.0]);
        (gaussian.choice, gaussian.environment) = (None, "walker2d".to_owned());
        let mut diffusion = scored("b", 10, &[1.0]);
        diffusion.precision = "bf16-amx".to_owned();
        let table = super::table(&[gaussian, diffusion]);
        assert!(!table.contains("mean of") && table.contains(" 1.00\n"), "{table}");
        assert!(table.contains("no candidates  10 candidates"), "{table}");
        assert!(table.contains("bf16-amx and f32-avx2"), "{table}");
    }
}
