//! From a preset and flags to one validated experiment, and what a run saves of it.

pub mod device;
mod error;

use std::path::PathBuf;

use quad_dataset::{RewardRule, environment};
use quad_policy::Precision;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use crate::algorithms::{self, Definition, Hyperparameters};
use crate::presets;
use crate::schedule::Schedule;

use device::Device;
pub use error::ConfigError;

/// Most episodes in one evaluation, and most candidates per state: far above any use, low enough for evaluators' memory.
const MOST_EPISODES: u32 = 10_000;
const MOST_CANDIDATES: u32 = 1_000;
/// Most transitions in a batch: far above any use, too.
const MOST_BATCH: u32 = 1 << 20;

/// Everything that decides the outcome of a run, apart from the contents of the dataset: a preset, resolved.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Environment that the data is from and the policy is evaluated in.
    pub environment: String,
    /// What it learns from: a name, or a file. [`DatasetInfo`] says what was found there.
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
    /// Arithmetic of what no gradient is taken of.
    #[serde(default)]
    pub precision: Precision,
    /// Name of the learning algorithm.
    pub algorithm: String,
    /// Its hyper-parameters.
    pub agent: Table,
}

/// What a run folder says about itself in `config.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Which run this is.
    pub run: RunInfo,
    /// What it learns from.
    pub dataset: DatasetInfo,
    /// How it learns.
    pub experiment: Experiment,
}

/// Which run this is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunInfo {
    /// Name of the run: its folder's name, and its place in Zenoh's key space.
    pub name: String,
    /// When the run began, in milliseconds since 1970.
    pub incarnation: u64,
    /// Preset that was asked for.
    pub preset: String,
    /// Version of the learner.
    pub version: String,
    /// Where it trains; runs from before there was a choice do not say.
    #[serde(default)]
    pub device: Device,
}

/// What the run learns from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetInfo {
    /// The file.
    pub path: PathBuf,
    /// SHA-256 of the file in hexadecimal, of a folder of Minari's that of its `main_data.hdf5`; older runs do not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
    /// Transitions that are learnt from.
    pub transitions: u64,
    /// Trajectories in the file.
    pub episodes: u64,
    /// Smallest, mean and largest return of a trajectory, unscaled.
    pub min_return: f64,
    /// See `min_return`.
    pub mean_return: f64,
    /// See `min_return`.
    pub max_return: f64,
    /// Mean D4RL-normalised score of the trajectories, where the environment has reference returns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mean_score: Option<f64>,
}

impl DatasetInfo {
    /// How much it holds and how good it is, in one line.
    pub fn summary(&self) -> String {
        let Self { transitions, episodes, mean_return, mean_score, .. } = self;
        let score = mean_score.map(|score| format!(", mean score {score:.2}")).unwrap_or_default();
        format!("{transitions} transitions of {episodes} episodes, mean return {mean_return:.2}{score}")
    }
}

/// Reads a preset (an embedded name, or a path that ends in `.toml`), lays changes over it, checks every range.
///
/// # Errors
/// There is no such preset, or something in it or in the changes cannot be used.
pub fn resolve(preset: &str, changes: &Table) -> Result<Experiment, ConfigError> {
    let mut table = presets::load(preset)?;
    presets::merge(&mut table, changes.clone());
    if let Some((key, nearest)) = presets::unknown_key(&table) {
        return Err(ConfigError::Key { key, nearest });
    }
    let unusable = |source| ConfigError::Parse { preset: preset.to_owned(), source: Box::new(source) };
    let Some(environment) = table.get("environment") else { return Err(ConfigError::Base(preset.to_owned())) };
    if !table.contains_key("reward") {
        let known = environment.as_str().and_then(|name| environment::find(name).ok());
        let rule = known.map_or(RewardRule::AsIs, |spec| spec.reward);
        let rule = Value::try_from(rule).map_err(|error| unusable(serde::de::Error::custom(error)))?;
        table.insert("reward".to_owned(), rule);
    }
    let experiment: Experiment = table.try_into().map_err(unusable)?;
    experiment.validate()?;
    if !experiment.hyperparameters()?.samples_candidates() && experiment.candidates != 1 {
        return Err(ConfigError::Candidates(experiment.candidates));
    }
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
        let range = |field, value: u64, least: u64, most: u64| {
            if (least..=most).contains(&value) {
                return Ok(());
            }
            Err(ConfigError::Range { field, value, least, most })
        };
        // TOML's integers are 64 bits with a sign, so larger ones could not be saved with the run.
        const MOST: u64 = i64::MAX as u64;
        range("steps", self.steps, 1, MOST)?;
        range("eval_interval", self.eval_interval, 0, MOST)?;
        range("seed", self.seed, 0, MOST)?;
        range("episodes", self.episodes.into(), 1, MOST_EPISODES.into())?;
        range("candidates", self.candidates.into(), 1, MOST_CANDIDATES.into())?;
        range("batch_size", self.batch_size.into(), 1, MOST_BATCH.into())
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
    fn a_reward_rule_that_is_not_given_is_the_environments() {
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
    fn unknown_and_missing_keys_are_errors() {
        let error = refused(toml! { candidate = 3 });
        assert_eq!(error.to_string(), "there is nothing to set by the name candidate");
        assert_eq!(error.hint().unwrap(), "did you mean candidates?");
        let error = refused(toml! { agent.learning_rate = 1.0 });
        assert!(error.hint().unwrap().contains("agent.actor_learning_rate"), "{error}");
        let error = refused(toml! { agent.eta.treshold = 1.0 });
        assert!(error.hint().unwrap().contains("agent.eta.threshold"), "{error}");
        let error = resolve("paper", &toml! { environment = "hopper" }).unwrap_err().to_string();
        assert!(error.contains("missing field"), "{error}");
    }

    /// What serde says of a field that no struct has: it lists those that there are.
    #[test]
    fn every_key_that_there_is_can_be_offered() {
        for (preset, lists) in [("hopper-medium-v2", &["", "agent", "agent.eta"][..]), ("hopper-demo-iql", &["agent"])]
        {
            for list in lists {
                let mut table = Table::try_from(resolve(preset, &Table::new()).unwrap()).unwrap();
                let inner = list.split('.').filter(|key| !key.is_empty());
                let inner = inner.fold(&mut table, |table, key| table[key].as_table_mut().unwrap());
                inner.insert("no-such-key".to_owned(), 1.into());
                let error = match table.try_into::<Experiment>() {
                    Ok(experiment) => experiment.hyperparameters().err().unwrap().to_string(),
                    Err(error) => error.to_string(),
                };
                let (_, fields) = error.split_once("expected one of").unwrap();
                // The tables, whose keys come in their turn, and the end of the message, which says where it was.
                let tables = ["agent", "eta"];
                let fields: Vec<_> = fields.split('`').skip(1).step_by(2).filter(|f| !tables.contains(f)).collect();
                assert!(fields.len() >= 4, "{error}");
                for field in fields {
                    let key = format!("{list}.{field}");
                    let change = presets::parse_assignment(&format!("{}=1", key.trim_start_matches('.'))).unwrap();
                    let mut table = presets::load(preset).unwrap();
                    presets::merge(&mut table, change);
                    assert_eq!(presets::unknown_key(&table), None, "{key}");
                }
            }
        }
    }

    #[test]
    fn values_out_of_range_are_errors() {
        assert!(matches!(refused(toml! { episodes = 0 }), ConfigError::Range { field: "episodes", .. }));
        assert!(matches!(refused(toml! { agent.samples = 0 }), ConfigError::Agent { .. }));
        let error = refused(toml! { agent.guidance = "sac" }).to_string();
        assert!(error.contains("sac") && error.contains("dac"), "the names that there are are offered: {error}");
        let error = resolve("hopper-demo-iql", &toml! { agent.samples = 3 }).unwrap_err().to_string();
        assert!(error.contains("agent.samples"), "{error}");
        let error = resolve("hopper-demo-iql", &toml! { candidates = 10 }).unwrap_err();
        assert!(matches!(error, ConfigError::Candidates(10)));
        let unknown = refused(toml! { algorithm = "sac" });
        assert!(unknown.to_string().contains("quad, iql"), "{unknown}");
    }

    #[test]
    fn a_path_is_read_and_a_missing_one_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        std::fs::write(&path, "base = \"hopper-demo\"\nsteps = 7\n").unwrap();
        let path = path.to_str().unwrap();
        let changed = resolve("hopper-demo", &toml! { steps = 7 }).unwrap();
        assert_eq!(resolve(path, &Table::new()).unwrap(), changed);
        assert_eq!(presets::label(path), "mine");
        let missing = resolve("nowhere/x.toml", &Table::new()).unwrap_err();
        assert!(missing.to_string().contains("nowhere/x.toml"), "{missing}");
        std::fs::write(path, "base = \"hoper-demo\"\n").unwrap();
        let unknown = resolve(path, &Table::new()).unwrap_err();
        assert!(unknown.hint().unwrap().contains("hopper-demo"), "{unknown}");
    }
}
