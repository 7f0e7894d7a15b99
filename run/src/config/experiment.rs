//! One experiment, every value of which is checked.

use anyhow::{Context, anyhow, ensure};
use quad_algorithms::{Definition, Reporting, Variant};
use quad_dataset::{RewardRule, Scale};
use quad_policy::Precision;
use quad_runtime::Hint;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::hyperparameters;
use super::schedule::Schedule;

/// Most episodes in one evaluation: far above any use.
const MOST_EPISODES: u64 = 10_000;
/// Most transitions in a batch: far above any use, too.
const MOST_BATCH: u64 = 1 << 20;
/// Most evaluations in a run: far above any use. Each keeps a snapshot.
const MOST_EVALUATIONS: u64 = 1_000_000;
/// TOML's integers are 64 bits with a sign, so larger ones could not be saved with the run.
const MOST: u64 = i64::MAX as u64;

/// Everything that decides the outcome of a run, apart from the contents of the dataset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Environment that the data is from and the policy is evaluated in.
    pub environment: String,
    /// What it learns from: a name, or a file. [`DatasetInfo`](super::DatasetInfo) says what was
    /// found there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dataset: Option<String>,
    /// How rewards are scaled before training; a file that does not say takes the environment's
    /// rule.
    pub reward: RewardRule,
    /// What of the data is scaled for the networks; the snapshots have the maps, so that policies
    /// take and give the data's units.
    #[serde(default)]
    pub scale: Scale,
    /// Share of the episodes that is kept out of training, to measure on; 0: none. Which they are
    /// follows from the seed.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub hold_out: f64,
    /// Gradient steps.
    pub steps: u64,
    /// Gradient steps between two evaluations; 0: none at all.
    pub eval_interval: u64,
    /// Episodes per evaluation.
    pub episodes: u32,
    /// Seed of initial weights, batches, noise and the evaluations' episodes.
    pub seed: u64,
    /// Transitions per gradient step, B.
    pub batch_size: u32,
    /// Precision of forward passes without gradient.
    #[serde(default)]
    pub precision: Precision,
    /// Name of the learning algorithm.
    pub algorithm: String,
    /// Its hyper-parameters.
    pub agent: Table,
}

fn is_zero(share: &f64) -> bool {
    *share == 0.0
}

/// For a key that is too few or too many, or of a wrong type. What serde says of it lists the keys
/// that there are.
pub(super) const KEYS: &str = "`learner presets TASK` prints every key; on the command line --set KEY=VALUE changes one, and \
                               --agent KEY=VALUE one below [agent]";

impl Experiment {
    /// The algorithm.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn definition(&self) -> anyhow::Result<Definition> {
        hyperparameters::algorithm(&self.algorithm)
    }

    /// What tells variants of the algorithm apart in the names of runs: a hyper-parameter's value,
    /// or the algorithm's name.
    ///
    /// # Errors
    /// As [`Self::definition`].
    pub fn variant(&self) -> anyhow::Result<&str> {
        let variant = self.definition()?.report.variant;
        let value = variant.and_then(|variant| self.agent.get(variant.key)).and_then(Value::as_str);
        Ok(value.unwrap_or(&self.algorithm))
    }

    /// What tables and figures call the variant.
    ///
    /// # Errors
    /// As [`Self::definition`].
    pub fn called(&self) -> anyhow::Result<String> {
        let (known, variant) = (self.definition()?.report.variant, self.variant()?);
        Ok(known.map_or_else(|| variant.to_owned(), |known| (known.called)(variant)))
    }

    /// The algorithm as people read it: its name, its variant where there are several, and counts,
    /// such as candidates, where it has some.
    ///
    /// # Errors
    /// As [`Self::definition`].
    pub fn method(&self) -> anyhow::Result<String> {
        let Reporting { variant, counts, .. } = self.definition()?.report;
        let mut method = self.algorithm.clone();
        if let Some(Variant { key, .. }) = variant {
            method += &format!(", {key} {}", self.variant()?);
        }
        for (count, key) in counts.iter().filter_map(|key| Some((self.agent.get(*key)?, key))) {
            method += &format!(", {count} {key}");
        }
        Ok(method)
    }

    /// How many gradient steps there are, and which are evaluated.
    pub fn schedule(&self) -> Schedule {
        Schedule { steps: self.steps, eval_interval: self.eval_interval }
    }

    /// The figures that tell runs apart, in one line.
    ///
    /// # Errors
    /// As [`Self::definition`].
    pub fn summary(&self) -> anyhow::Result<String> {
        let Self { steps, eval_interval, episodes, seed, batch_size, .. } = self;
        let evaluations = match eval_interval {
            0 => "no evaluations".to_owned(),
            _ => format!("{episodes} episodes every {eval_interval}"),
        };
        Ok(format!(
            "{}; seed {seed}, {steps} steps of batch {batch_size}; {evaluations}",
            self.method()?
        ))
    }

    /// Checks the numbers that are no hyper-parameters.
    ///
    /// # Errors
    /// One of them is not in its range.
    pub(crate) fn check_ranges(&self) -> anyhow::Result<()> {
        for (field, value, least, most) in [
            ("steps", self.steps, 1, MOST),
            ("eval_interval", self.eval_interval, 0, MOST),
            ("seed", self.seed, 0, MOST),
            ("episodes", self.episodes.into(), 1, MOST_EPISODES),
            ("batch_size", self.batch_size.into(), 1, MOST_BATCH),
        ] {
            ensure!(
                (least..=most).contains(&value),
                "{field} is {value}, but must be from {least} to {most}"
            );
        }
        let share = self.hold_out;
        ensure!(
            (0.0..1.0).contains(&share),
            "hold_out is {share}, but must be at least 0 and below 1"
        );
        Ok(())
    }

    pub(super) fn validate(&self) -> anyhow::Result<()> {
        self.check_ranges()?;
        let (Self { steps, eval_interval, .. }, evaluations) =
            (self, self.schedule().evaluations());
        if evaluations > MOST_EVALUATIONS {
            let error = anyhow!(
                "{steps} steps with an evaluation every {eval_interval} are {evaluations} evaluations"
            );
            return Err(error)
                .hint(format!("choose a larger eval_interval, for at most {MOST_EVALUATIONS}"));
        }
        let check = (self.definition()?.check)(&self.agent);
        check.with_context(|| format!("algorithm {}", self.algorithm)).hint(KEYS)
    }
}

#[cfg(test)]
mod tests;
