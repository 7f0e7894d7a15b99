//! Results of `learner judge`: values of policies, estimated without a simulator, and a ranking.

use std::fmt::Alignment::{Left, Right};
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::statistics::Spread;
use crate::counted;
use crate::folder::{Lock, RunDir, RunDirError};
use crate::table::{Block, Table};

const FILE: &str = "judgments.json";
const LOCK: &str = "judgments.lock";

/// Conditions of judgments. Judgments under equal conditions can be compared.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Conditions {
    /// SHA-256 of the data.
    pub dataset: String,
    /// The environment of the rewards; empty in older files.
    #[serde(default)]
    pub environment: String,
    /// Indices of the episodes in whose first states policies are judged, in the file's order.
    pub episodes: Vec<usize>,
    /// Discount γ.
    pub gamma: f32,
    /// Gradient steps of an evaluation.
    pub steps: u64,
    /// Evaluations of each policy, from seeds 0, 1, ….
    pub seeds: u64,
}

/// An estimated value: the mean discounted return from the first states of the judged episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// A value per seed.
    pub values: Vec<f64>,
    /// Reasons why the estimate is unreliable, a sentence each.
    pub doubts: Vec<String>,
}

impl Estimate {
    /// Spread over the seeds; `None` for an unreliable estimate.
    fn spread(&self) -> Option<Spread> {
        Spread::new(&self.values).filter(|_| self.doubts.is_empty())
    }
}

/// The judgment of one policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Judgment {
    /// The folder of its run, as the reader calls it.
    #[serde(default)]
    pub run: PathBuf,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// BLAKE3 of the snapshot's file.
    pub weights: String,
    pub conditions: Conditions,
    pub estimate: Estimate,
    /// Root mean square distance of its actions from the data's in the judged episodes, in standard
    /// deviations of the data's.
    pub distance: f64,
    /// True if its training had none of the judged episodes.
    pub unseen: bool,
    /// Why it acts otherwise in an episode than it is judged, in a sentence; absent in older files.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub caveat: Option<String>,
    /// The value of the behavior that recorded the data, estimated like the policy's.
    pub behavior: Estimate,
    /// The behavior's value by the data: the mean discounted return of the judged episodes. The rest
    /// of a truncated episode is estimated.
    pub recorded: f64,
}

impl Judgment {
    /// The judgments in a run's folder, without those of unknown environments.
    pub fn read_all(folder: &RunDir) -> Result<Vec<Self>, RunDirError> {
        if !folder.path().join(FILE).exists() {
            return Ok(Vec::new());
        }
        let mut judgments: Vec<Self> = folder.read_json(FILE)?;
        judgments.retain(|judgment| !judgment.conditions.environment.is_empty());
        judgments.iter_mut().for_each(|judgment| judgment.run = folder.path().to_owned());
        Ok(judgments)
    }

    /// Saves the judgment in the folder and replaces an earlier one of the same step under the same
    /// conditions, or of other weights. Waits for other processes that save one.
    pub fn save(&self, folder: &RunDir) -> Result<(), RunDirError> {
        let path = folder.path().join(LOCK);
        let _lock = loop {
            match Lock::take(&path) {
                Err(RunDirError::InUse(_)) => {}
                taken => break taken?,
            }
        };
        let mut judgments = Self::read_all(folder)?;
        judgments.retain(|earlier| {
            let is_same = earlier.weights == self.weights && earlier.conditions != self.conditions;
            earlier.step != self.step || is_same
        });
        judgments.push(self.clone());
        judgments.sort_by_key(|judgment| judgment.step);
        folder.write_json(FILE, &judgments)
    }

    fn doubts(&self) -> String {
        let mut doubts = self.estimate.doubts.clone();
        if !self.unseen {
            doubts.push("has learned from some of these episodes".to_owned());
        }
        doubts.extend(self.caveat.clone());
        doubts.join("; ")
    }
}

/// Policies that were judged under equal conditions, the best first, unreliable ones last.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[allow(missing_docs)] // As in [`Judgment`].
pub struct Ranking {
    pub conditions: Conditions,
    pub behavior: Estimate,
    pub recorded: f64,
    /// True if the policies' values differ by more than the error of the behavior's estimate and the
    /// noise of seeds.
    pub can_rank: bool,
    /// The conclusion in words.
    pub verdict: String,
    pub policies: Vec<Judgment>,
}

impl Ranking {
    /// A ranking for each set of conditions.
    pub fn from_judgments(judgments: impl IntoIterator<Item = Judgment>) -> Vec<Self> {
        let mut groups: Vec<Vec<Judgment>> = Vec::new();
        for judgment in judgments {
            match groups.iter_mut().find(|group| group[0].conditions == judgment.conditions) {
                Some(group) => group.push(judgment),
                None => groups.push(vec![judgment]),
            }
        }
        groups.into_iter().map(Self::from_group).collect()
    }

    fn from_group(mut policies: Vec<Judgment>) -> Self {
        let spread = |judgment: &Judgment| judgment.estimate.spread();
        let value =
            |judgment: &Judgment| spread(judgment).map_or(f64::NEG_INFINITY, |spread| spread.mean);
        policies.sort_by(|one, other| value(other).total_cmp(&value(one)));
        let first = policies[0].clone();
        let reliable = Vec::from_iter(policies.iter().filter_map(spread));
        let (can_rank, verdict) = verdict(&reliable, &first);
        Self {
            conditions: first.conditions,
            behavior: first.behavior,
            recorded: first.recorded,
            can_rank,
            verdict,
            policies,
        }
    }

    /// A paragraph and a table.
    pub fn blocks(&self) -> [Block; 2] {
        let left = ["policy", "doubts"];
        let alignment = |name| (name, if left.contains(&name) { Left } else { Right });
        let header = ["rank", "policy", "value", "distance", "doubts"];
        let mut table = Table::new(&header.map(alignment));
        let mut push = |cells: [&str; 5]| table.push(cells.map(str::to_owned));
        let value = |estimate: &Estimate| estimate.spread().map_or("-".to_owned(), Spread::text);
        for (judgment, rank) in self.policies.iter().zip(1..) {
            let estimate = &judgment.estimate;
            let rank = match self.can_rank && estimate.doubts.is_empty() {
                true => rank.to_string(),
                false => "-".to_owned(),
            };
            let name = format!("{} @ {}", judgment.run.display(), judgment.step);
            let (value, distance) = (value(estimate), format!("{:.2}", judgment.distance));
            push([&rank, &name, &value, &distance, &judgment.doubts()]);
        }
        let doubts = self.behavior.doubts.join("; ");
        let (estimated, recorded) = (value(&self.behavior), format!("{:.2}", self.recorded));
        push(["-", "behavior, estimated", &estimated, "", &doubts]);
        push(["-", "behavior, as recorded", &recorded, "", ""]);
        let Conditions { environment, gamma, steps, seeds, episodes, .. } = &self.conditions;
        let (verdict, episodes) = (&self.verdict, counted(episodes.len(), "episode"));
        let text = format!(
            "Judged without a simulator: a ranking, not a score.\n{verdict}\nValues are discounted returns (γ = {gamma}) in {environment} \
             from the first states of {episodes} on, estimated by fitted Q evaluation ({steps} steps), ± standard deviation over {seeds} seeds. \
             Distance: of the policy's actions from the data's, in standard deviations of the data's.\n"
        );
        [Block::Text(text), Block::Table(table)]
    }
}

/// Decides if policies of these values, in descending order, can be ranked; also returns the reason.
fn verdict(values: &[Spread], judged: &Judgment) -> (bool, String) {
    let (Some(most), Some(least)) = (values.first(), values.last()) else {
        return (false, "It cannot rank them: no estimate can be relied on.".to_owned());
    };
    let Some(estimated) = judged.behavior.spread() else {
        let doubtful = "It cannot rank them: the estimate of the behavior's own value is doubtful.";
        return (false, doubtful.to_owned());
    };
    let off = (estimated.mean - judged.recorded).abs();
    let range = most.mean - least.mean;
    // Twice the standard error of a difference of two means over the seeds.
    let squares: f64 = values.iter().map(|value| value.std.unwrap_or(0.0).powi(2)).sum();
    let variance = squares / values.len() as f64;
    let noise = 2.0 * (2.0 * variance / judged.conditions.seeds as f64).sqrt();
    let behind = format!(
        "the behavior's own value is estimated {off:.2} off, and by other seeds two policies differ by {noise:.2}"
    );
    let margin = off.max(noise);
    let can_rank = values.len() > 1 && margin < range;
    let verdict = if values.len() == 1 {
        format!("One value is no ranking; the behavior's own value is estimated {off:.2} off.")
    } else if can_rank {
        format!(
            "Policies whose values differ by less than {margin:.2} are not told apart: {behind}."
        )
    } else {
        format!("It cannot rank them: {behind}, these by no more than {range:.2}.")
    };
    (can_rank, verdict)
}

#[cfg(test)]
mod tests;
