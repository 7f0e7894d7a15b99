//! What `learner judge` found out about policies, without a simulator: estimates of their values,
//! and whether these can rank them.

use std::fmt::Alignment::{Left, Right};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::spread::Spread;
use crate::folder::{Lock, RunDir, RunDirError};
use crate::table::{Block, Table};

const FILE: &str = "judgments.json";
const LOCK: &str = "judgments.lock";

/// How judgments were made: those that were made alike can be compared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Conditions {
    /// SHA-256 of the data.
    pub dataset: String,
    /// The environment, whose task the rewards may be of; empty where an earlier learner did not
    /// say.
    #[serde(default)]
    pub environment: String,
    /// Numbers of the episodes in whose first states policies are judged, from 0 in the order of
    /// the file.
    pub episodes: Vec<usize>,
    /// Discount γ of the values.
    pub gamma: f32,
    /// Gradient steps of an evaluation.
    pub steps: u64,
    /// Evaluations of each policy, from seeds 0, 1, ….
    pub seeds: u64,
}

/// An estimated value: the mean over the judged episodes' first states of the discounted return
/// from there on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// One for each seed.
    pub values: Vec<f64>,
    /// What makes it no estimate, a sentence each, such as that it still moves.
    pub doubts: Vec<String>,
}

impl Estimate {
    /// Over the seeds; none where it is doubtful, because a number beyond all bounds has no part in
    /// a mean.
    fn spread(&self) -> Option<Spread> {
        Spread::of(&self.values).filter(|_| self.doubts.is_empty())
    }
}

/// What is known of one policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Judgment {
    /// The folder of its run, as the reader calls it.
    #[serde(default)]
    pub run: PathBuf,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// BLAKE3 of the snapshot's file.
    pub weights: String,
    /// How it was judged.
    pub conditions: Conditions,
    /// Its value.
    pub estimate: Estimate,
    /// How far its actions lie from the data's in the judged episodes: root mean square, in
    /// standard deviations of the data's.
    pub distance: f64,
    /// Whether it has learned from none of the judged episodes.
    pub unseen: bool,
    /// The value of the behavior that recorded the data, estimated likewise.
    pub behavior: Estimate,
    /// The behavior's value as the judged episodes have it: the mean of their discounted returns.
    /// What comes after an episode that was cut off is taken from the estimate.
    pub recorded: f64,
}

impl Judgment {
    /// The judgments of a run's snapshots that its folder has, but for those that may be of another
    /// task's rewards.
    ///
    /// # Errors
    /// The file cannot be read, or is not what `learner judge` writes.
    pub fn read_all(folder: &RunDir) -> Result<Vec<Self>, RunDirError> {
        if !folder.path().join(FILE).exists() {
            return Ok(Vec::new());
        }
        let mut judgments: Vec<Self> = folder.read_json(FILE)?;
        judgments.retain(|judgment| !judgment.conditions.environment.is_empty());
        judgments.iter_mut().for_each(|judgment| judgment.run = folder.path().to_owned());
        Ok(judgments)
    }

    /// Keeps it in the folder, in the place of an earlier one of the same step. Waits for another
    /// process that is doing so.
    ///
    /// # Errors
    /// Those of [`Self::read_all`], or the file cannot be written.
    pub fn keep(&self, folder: &RunDir) -> Result<(), RunDirError> {
        let path = folder.path().join(LOCK);
        let _lock = loop {
            match Lock::take(&path) {
                Err(RunDirError::InUse(_)) => {}
                taken => break taken?,
            }
        };
        let mut judgments = Self::read_all(folder)?;
        judgments.retain(|earlier| earlier.step != self.step);
        judgments.push(self.clone());
        judgments.sort_by_key(|judgment| judgment.step);
        folder.write_json(FILE, &judgments)
    }
}

/// Policies that were judged alike, the best first; those of doubtful estimates come last.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Ranking {
    /// How they were judged.
    pub conditions: Conditions,
    /// The behavior's value, estimated.
    pub behavior: Estimate,
    /// The behavior's value, recorded.
    pub recorded: f64,
    /// Whether the policies' values differ by more than the estimate of the behavior is off, and
    /// than other seeds would change them.
    pub can_rank: bool,
    /// What follows from this, in words.
    pub verdict: String,
    /// The policies.
    pub policies: Vec<Judgment>,
}

impl Ranking {
    /// A ranking of each kind of conditions, in the order in which they come.
    pub fn of(judgments: impl IntoIterator<Item = Judgment>) -> Vec<Self> {
        let mut groups: Vec<Vec<Judgment>> = Vec::new();
        for judgment in judgments {
            match groups.iter_mut().find(|group| group[0].conditions == judgment.conditions) {
                Some(group) => group.push(judgment),
                None => groups.push(vec![judgment]),
            }
        }
        groups.into_iter().map(Self::of_group).collect()
    }

    fn of_group(mut policies: Vec<Judgment>) -> Self {
        let value = |judgment: &Judgment| {
            judgment.estimate.spread().map_or(f64::NEG_INFINITY, |spread| spread.mean)
        };
        policies.sort_by(|one, other| value(other).total_cmp(&value(one)));
        let Judgment { conditions, behavior, recorded, .. } = policies[0].clone();
        let sure =
            Vec::from_iter(policies.iter().filter_map(|judgment| judgment.estimate.spread()));
        let (can_rank, verdict) = verdict(&sure, conditions.seeds, &behavior, recorded);
        Self { conditions, behavior, recorded, can_rank, verdict, policies }
    }

    /// As words and a table.
    pub fn parts(&self) -> [Block; 2] {
        let Self {
            conditions: Conditions { environment, episodes, gamma, steps, seeds, .. },
            policies,
            ..
        } = self;
        let columns = [
            ("rank", Right),
            ("policy", Left),
            ("value", Right),
            ("distance", Right),
            ("doubts", Left),
        ];
        let mut table = Table::new(&columns);
        let value = |of: &Estimate| of.spread().map_or_else(|| "-".to_owned(), Spread::text);
        for (judgment, rank) in policies.iter().zip(1..) {
            let Judgment { run, step, estimate, distance, unseen, .. } = judgment;
            let mut doubts = estimate.doubts.clone();
            doubts.extend((!unseen).then(|| "has learned from some of these episodes".to_owned()));
            let rank = if estimate.doubts.is_empty() && self.can_rank {
                format!("{rank}")
            } else {
                "-".to_owned()
            };
            table.push([
                rank,
                format!("{} @ {step}", run.display()),
                value(estimate),
                format!("{distance:.2}"),
                doubts.join("; "),
            ]);
        }
        let behavior = ["-".to_owned(), "behavior, estimated".to_owned(), value(&self.behavior)];
        table.push([&behavior[..], &["".to_owned(), self.behavior.doubts.join("; ")]].concat());
        let recorded = ["-", "behavior, as recorded", &format!("{:.2}", self.recorded), "", ""];
        table.push(recorded.map(str::to_owned));
        let words = format!(
            "Judged without a simulator: a ranking, not a score.\n{}\nValues are discounted returns (γ = {gamma}) in {environment} \
             from the first states of {} episodes on, estimated by fitted Q evaluation ({steps} steps), ± standard deviation over {seeds} seeds. \
             Distance: of the policy's actions from the data's, in standard deviations of the data's.\n",
            self.verdict,
            episodes.len(),
        );
        [Block::Text(words), Block::Table(table)]
    }
}

/// Whether policies of these values, the largest first, can be told apart, and why.
fn verdict(values: &[Spread], seeds: u64, behavior: &Estimate, recorded: f64) -> (bool, String) {
    let (Some(most), Some(least)) = (values.first(), values.last()) else {
        return (false, "It cannot rank them: no estimate can be relied on.".to_owned());
    };
    let Some(estimated) = behavior.spread() else {
        return (
            false,
            "It cannot rank them: the estimate of the behavior's own value is doubtful.".to_owned(),
        );
    };
    let (off, range) = ((estimated.mean - recorded).abs(), most.mean - least.mean);
    // Twice the standard error of a difference of two means over the seeds.
    let variance = values.iter().map(|value| value.std.unwrap_or(0.0).powi(2)).sum::<f64>()
        / values.len() as f64;
    let noise = 2.0 * (2.0 * variance / seeds as f64).sqrt();
    let behind = format!(
        "the behavior's own value is estimated {off:.2} off, and by other seeds two policies differ by {noise:.2}"
    );
    let margin = off.max(noise);
    match values.len() {
        1 => (
            false,
            format!("One value is no ranking; the behavior's own value is estimated {off:.2} off."),
        ),
        _ if margin >= range => {
            (false, format!("It cannot rank them: {behind}, these by no more than {range:.2}."))
        }
        _ => (
            true,
            format!(
                "Policies whose values differ by less than {margin:.2} are not told apart: {behind}."
            ),
        ),
    }
}

#[cfg(test)]
mod tests;
