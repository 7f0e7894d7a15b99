//! From a preset and changes to one experiment, every value of which is checked.

use anyhow::{Context, anyhow, ensure};
use quad_dataset::{RewardRule, environment};
use quad_policy::Precision;
use quad_service::Hint;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::presets;
use super::schedule::Schedule;
use crate::algorithms::{self, ALGORITHMS, Definition, Hyperparameters};

/// Most episodes in one evaluation: far above any use.
const MOST_EPISODES: u64 = 10_000;
/// Most transitions in a batch: far above any use, too.
const MOST_BATCH: u64 = 1 << 20;
/// TOML's integers are 64 bits with a sign, so larger ones could not be saved with the run.
const MOST: u64 = i64::MAX as u64;

/// Everything that decides the outcome of a run, apart from the contents of the dataset: a preset, resolved.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Environment that the data is from and the policy is evaluated in.
    pub environment: String,
    /// What it learns from: a name, or a file. [`DatasetInfo`](super::DatasetInfo) says what was found there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dataset: Option<String>,
    /// How rewards are scaled before training; a preset that does not say takes the environment's rule.
    pub reward: RewardRule,
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

/// For a key that is too few or too many, or of a wrong type. What serde says of it lists the keys that there are.
const KEYS: &str =
    "`learner presets NAME` prints every key of a preset; on the command line those below [agent] are agent.KEY";

/// Reads a preset (an embedded name, or a path that ends in `.toml`), lays changes over it, checks every range.
///
/// # Errors
/// There is no such preset, or something in it or in the changes cannot be used.
pub fn resolve(preset: &str, changes: &Table) -> anyhow::Result<Experiment> {
    let mut table = presets::load(preset)?;
    presets::merge(&mut table, changes.clone());
    let Some(environment) = table.get("environment") else {
        return Err(anyhow!("preset {preset} names no environment: it is a base of other presets"))
            .hint("`learner presets` lists the presets that can be trained");
    };
    if !table.contains_key("reward") {
        let known = environment.as_str().and_then(|name| environment::find(name).ok());
        let rule = known.map_or(RewardRule::AsIs, |spec| spec.reward);
        table.insert("reward".to_owned(), Value::try_from(rule)?);
    }
    let experiment: Experiment =
        table.try_into().with_context(|| format!("preset {preset} cannot be used")).hint(KEYS)?;
    experiment.validate()?;
    Ok(experiment)
}

impl Experiment {
    /// The algorithm.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn definition(&self) -> anyhow::Result<Definition> {
        let known = || ALGORITHMS.map(|known| known.name).join(", ");
        let unknown = || anyhow!("there is no algorithm named {:?}; there are {}", self.algorithm, known());
        algorithms::named(&self.algorithm).ok_or_else(unknown)
    }

    /// The algorithm's hyper-parameters.
    ///
    /// # Errors
    /// They are not usable, which is found when a preset is resolved.
    pub fn hyperparameters(&self) -> anyhow::Result<Box<dyn Hyperparameters>> {
        let read = (self.definition()?.read)(&self.agent);
        read.with_context(|| format!("algorithm {}", self.algorithm)).hint(KEYS)
    }

    /// How many gradient steps there are, and which are evaluated.
    pub fn schedule(&self) -> Schedule {
        Schedule { steps: self.steps, eval_interval: self.eval_interval }
    }

    /// The figures that tell runs apart, in one line.
    ///
    /// # Errors
    /// As [`Self::hyperparameters`].
    pub fn summary(&self) -> anyhow::Result<String> {
        let Self { steps, eval_interval, episodes, seed, batch_size, .. } = self;
        let evaluations = match eval_interval {
            0 => "no evaluations".to_owned(),
            _ => format!("{episodes} episodes every {eval_interval}"),
        };
        let agent = self.hyperparameters()?.summary();
        Ok(format!("{agent}; seed {seed}, {steps} steps of batch {batch_size}; {evaluations}"))
    }

    fn validate(&self) -> anyhow::Result<()> {
        for (field, value, least, most) in [
            ("steps", self.steps, 1, MOST),
            ("eval_interval", self.eval_interval, 0, MOST),
            ("seed", self.seed, 0, MOST),
            ("episodes", self.episodes.into(), 1, MOST_EPISODES),
            ("batch_size", self.batch_size.into(), 1, MOST_BATCH),
        ] {
            ensure!((least..=most).contains(&value), "{field} is {value}, but must be from {least} to {most}");
        }
        self.hyperparameters().map(drop)
    }
}

#[cfg(test)]
#[path = "../../tests/unit/config/experiment.rs"]
mod tests;
