//! From a preset and changes to one experiment, every value of which is checked.

use quad_dataset::{RewardRule, environment};
use quad_policy::Precision;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::presets::{self, PresetError};
use super::schedule::Schedule;
use crate::algorithms::{self, ALGORITHMS, AgentError, Definition, Hyperparameters};

/// Most episodes in one evaluation, and most candidates per state: far above any use, low enough for evaluators' memory.
const MOST_EPISODES: u64 = 10_000;
const MOST_CANDIDATES: u64 = 1_000;
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
    /// Actions sampled per state in an evaluation, N_a of Eq. 25.
    pub candidates: u32,
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

/// An experiment that cannot be run.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// There is no such preset, or it is not TOML.
    #[error(transparent)]
    Preset(#[from] PresetError),
    /// A base of other presets, which cannot be trained by itself.
    #[error("preset {0} names no environment: it is a base of other presets")]
    Base(String),
    /// A key too few or too many, or a wrong type.
    #[error("preset {preset}: {source}")]
    Keys {
        /// The preset.
        preset: String,
        /// What is wrong, with the keys that there are.
        source: Box<toml::de::Error>,
    },
    /// An unknown algorithm.
    #[error("there is no algorithm named {0:?}; there are {known}", known = ALGORITHMS.map(|known| known.name).join(", "))]
    Algorithm(String),
    /// A hyper-parameter that the algorithm does not have, or one outside its range.
    #[error("[agent] of algorithm {algorithm}: {source}")]
    Agent {
        /// The algorithm.
        algorithm: String,
        /// What is wrong.
        source: AgentError,
    },
    /// Candidates for a policy that samples none.
    #[error("candidates is {0}, but the policy of this algorithm does not sample any, so it must be 1")]
    Candidates(u32),
    /// Another value outside its range.
    #[error("{field} is {value}, but must be from {least} to {most}")]
    #[allow(missing_docs)] // The message says it all.
    Range { field: &'static str, value: u64, least: u64, most: u64 },
}

impl ConfigError {
    /// What to do about it.
    pub fn hint(&self) -> Option<String> {
        match self {
            Self::Preset(error) => error.hint(),
            Self::Base(_) => Some("`learner presets` lists the presets that can be trained".to_owned()),
            Self::Keys { .. } | Self::Agent { .. } => Some(
                "`learner presets NAME` prints every key of a preset; on the command line those below [agent] are \
                 written agent.KEY"
                    .to_owned(),
            ),
            Self::Algorithm(_) | Self::Candidates(_) | Self::Range { .. } => None,
        }
    }
}

/// Reads a preset (an embedded name, or a path that ends in `.toml`), lays changes over it, checks every range.
///
/// # Errors
/// There is no such preset, or something in it or in the changes cannot be used.
pub fn resolve(preset: &str, changes: &Table) -> Result<Experiment, ConfigError> {
    let mut table = presets::load(preset)?;
    presets::merge(&mut table, changes.clone());
    let unusable = |source| ConfigError::Keys { preset: preset.to_owned(), source: Box::new(source) };
    let Some(environment) = table.get("environment") else { return Err(ConfigError::Base(preset.to_owned())) };
    if !table.contains_key("reward") {
        let known = environment.as_str().and_then(|name| environment::find(name).ok());
        let rule = known.map_or(RewardRule::AsIs, |spec| spec.reward);
        let rule = Value::try_from(rule).map_err(|error| unusable(serde::de::Error::custom(error)))?;
        table.insert("reward".to_owned(), rule);
    }
    let experiment: Experiment = table.try_into().map_err(unusable)?;
    experiment.validate()?;
    Ok(experiment)
}

impl Experiment {
    /// The algorithm.
    ///
    /// # Errors
    /// There is none of that name.
    pub fn definition(&self) -> Result<Definition, ConfigError> {
        algorithms::named(&self.algorithm).ok_or_else(|| ConfigError::Algorithm(self.algorithm.clone()))
    }

    /// The algorithm's hyper-parameters.
    ///
    /// # Errors
    /// They are not usable, which is found when a preset is resolved.
    pub fn hyperparameters(&self) -> Result<Box<dyn Hyperparameters>, ConfigError> {
        let described = |source| ConfigError::Agent { algorithm: self.algorithm.clone(), source };
        (self.definition()?.read)(&self.agent).map_err(described)
    }

    /// How many gradient steps there are, and which are evaluated.
    pub fn schedule(&self) -> Schedule {
        Schedule { steps: self.steps, eval_interval: self.eval_interval }
    }

    /// The figures that tell runs apart, in one line.
    ///
    /// # Errors
    /// As [`Self::hyperparameters`].
    pub fn summary(&self) -> Result<String, ConfigError> {
        let Self { steps, eval_interval, episodes, candidates, seed, batch_size, .. } = self;
        let evaluations = match eval_interval {
            0 => "no evaluations".to_owned(),
            _ => format!("{episodes} episodes with {candidates} candidates every {eval_interval}"),
        };
        let agent = self.hyperparameters()?.summary();
        Ok(format!("{agent}; seed {seed}, {steps} steps of batch {batch_size}; {evaluations}"))
    }

    fn validate(&self) -> Result<(), ConfigError> {
        for (field, value, least, most) in [
            ("steps", self.steps, 1, MOST),
            ("eval_interval", self.eval_interval, 0, MOST),
            ("seed", self.seed, 0, MOST),
            ("episodes", self.episodes.into(), 1, MOST_EPISODES),
            ("candidates", self.candidates.into(), 1, MOST_CANDIDATES),
            ("batch_size", self.batch_size.into(), 1, MOST_BATCH),
        ] {
            if !(least..=most).contains(&value) {
                return Err(ConfigError::Range { field, value, least, most });
            }
        }
        if !self.hyperparameters()?.samples_candidates() && self.candidates != 1 {
            return Err(ConfigError::Candidates(self.candidates));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use toml::toml;

    fn refused(changes: Table) -> ConfigError {
        resolve("hopper-demo", &changes).unwrap_err()
    }

    #[test]
    fn changes_override_the_preset() {
        let preset = resolve("hopper-demo", &Table::new()).unwrap();
        let resolved = resolve("hopper-demo", &toml! { steps = 5 agent.guidance = "none" agent.tau = 1 }).unwrap();
        assert_eq!((resolved.steps, resolved.eval_interval), (5, preset.eval_interval));
        assert_eq!((&resolved.agent["guidance"], &resolved.agent["tau"]), (&"none".into(), &1.0.into()));
    }

    #[test]
    fn a_file_is_a_preset_whose_reward_rule_is_the_environments_unless_it_says_another() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        let mut table = presets::load("hopper-demo").unwrap();
        table.remove("reward");
        std::fs::write(&path, table.to_string()).unwrap();
        let reward = |environment: &str| {
            let changes = Table::from_iter([("environment".to_owned(), environment.into())]);
            resolve(path.to_str().unwrap(), &changes).unwrap().reward
        };
        assert_eq!(reward("walker2d"), environment::find("walker2d").unwrap().reward);
        assert_eq!(reward("my-robot"), RewardRule::AsIs);
    }

    #[test]
    fn a_wrong_key_is_answered_with_those_that_there_are() {
        for (changes, words) in [
            (toml! { tau = 3 }, ["unknown field `tau`", "`candidates`"]),
            (toml! { agent.learning_rate = 1.0 }, ["unknown field `learning_rate`", "`actor_learning_rate`"]),
            (toml! { agent.eta.treshold = 1.0 }, ["unknown field `treshold`", "`threshold`"]),
        ] {
            let error = refused(changes);
            assert!(words.iter().all(|word| error.to_string().contains(word)), "{error}");
            assert!(error.hint().unwrap().contains("agent.KEY"), "{error}");
        }
        let error = resolve("paper", &toml! { environment = "hopper" }).unwrap_err().to_string();
        assert!(error.contains("missing field"), "{error}");
    }

    #[test]
    fn values_out_of_range_are_errors() {
        assert!(matches!(refused(toml! { episodes = 0 }), ConfigError::Range { field: "episodes", .. }));
        assert!(matches!(refused(toml! { agent.samples = 0 }), ConfigError::Agent { .. }));
        let error = refused(toml! { agent.guidance = "sac" }).to_string();
        assert!(error.contains("`quad`, `dac`, `none`"), "{error}");
        let error = refused(toml! { algorithm = "td3" }).to_string();
        assert!(error.contains("quad, iql"), "{error}");
        let error = resolve("hopper-demo-iql", &toml! { candidates = 2 }).unwrap_err();
        assert!(matches!(error, ConfigError::Candidates(2)));
    }
}
