//! One experiment, every value of which is checked.

use quad_algorithms::{AgentError, Definition};
use quad_dataset::{Normalize, RewardRule};
use quad_policy::Precision;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use toml::{Table, Value};

use super::error::{ConfigError, check_ranges};
use super::hyperparameters;
use super::online::Online;
use super::schedule::Schedule;
use crate::counted;

/// Upper bounds, far above any use; each evaluation keeps a snapshot.
const MOST_EPISODES: u64 = 10_000;
const MOST_BATCH: u64 = 1 << 20;
const MOST_SIZE: u64 = 1 << 20;
const MOST_EVALUATIONS: u64 = 1_000_000;
/// The largest integer of TOML, in which a run's settings are saved.
const MOST: u64 = i64::MAX as u64;

/// Everything that decides the outcome of a run, apart from the contents of the dataset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Environment that the data is from and the policy is evaluated in.
    pub environment: String,
    /// Names or paths of the dataset's files, in order; a file says a single one as text.
    /// [`DatasetInfo`](super::DatasetInfo) describes their contents.
    #[serde(
        default,
        skip_serializing_if = "Vec::is_empty",
        deserialize_with = "read_names",
        serialize_with = "write_names"
    )]
    pub dataset: Vec<String>,
    /// Lengths of an observation and an action, for a run without a dataset in an environment that
    /// QUAD does not simulate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sizes: Option<[usize; 2]>,
    /// Scaling of rewards before training; by default the environment's rule.
    pub reward: RewardRule,
    /// Columns that are normalized for the networks. Snapshots contain the maps, so policies take
    /// and return the data's units.
    #[serde(default)]
    pub normalize: Normalize,
    /// Fraction of the episodes that is kept out of training and measured on. The seed decides
    /// which episodes these are.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub hold_out: f64,
    /// Hash of another run's last checkpoint, from which this run continues after `steps`; `None`
    /// if it begins with step 0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    /// Gradient steps on the dataset alone.
    pub steps: u64,
    /// Gradient steps between two evaluations; 0 turns evaluations off.
    pub eval_interval: u64,
    /// Episodes per evaluation.
    pub episodes: u32,
    /// Seed of initial weights, batches, noise and evaluation episodes.
    pub seed: u64,
    /// Transitions per gradient step, B.
    pub batch_size: u32,
    /// Precision of products between hidden layers.
    #[serde(default)]
    pub precision: Precision,
    /// Name of the learning algorithm.
    pub algorithm: String,
    /// Online learning after `steps`; `None` without any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub online: Option<Online>,
    /// Hyper-parameters of the algorithm.
    pub agent: Table,
}

fn is_zero(share: &f64) -> bool {
    *share == 0.0
}

fn read_names<'de, D: Deserializer<'de>>(source: D) -> Result<Vec<String>, D::Error> {
    match Value::deserialize(source)? {
        Value::String(name) => Ok(vec![name]),
        names => names.try_into().map_err(D::Error::custom),
    }
}

fn write_names<S: Serializer>(names: &[String], serializer: S) -> Result<S::Ok, S::Error> {
    match names {
        [name] => name.serialize(serializer),
        names => names.serialize(serializer),
    }
}

impl Experiment {
    /// Looks up the algorithm by its name.
    pub fn definition(&self) -> Result<Definition, ConfigError> {
        hyperparameters::algorithm(&self.algorithm)
    }

    /// The variant of the algorithm, as names of runs have it: a hyper-parameter's value, or the
    /// algorithm's name.
    pub fn variant(&self) -> Result<&str, ConfigError> {
        let variant = self.definition()?.variant;
        let value = variant.and_then(|variant| self.agent.get(variant.key)).and_then(Value::as_str);
        Ok(value.unwrap_or(&self.algorithm))
    }

    /// The variant's label in tables and figures.
    pub fn label(&self) -> Result<String, ConfigError> {
        let (definition, variant) = (self.definition()?, self.variant()?);
        let label = definition.variant.map(|names| (names.called)(variant));
        Ok(label.unwrap_or_else(|| variant.to_owned()))
    }

    /// Name, variant and candidates of the algorithm: `quad, guidance dac, 10 candidates`.
    pub fn method(&self) -> Result<String, ConfigError> {
        let mut method = self.algorithm.clone();
        if let Some(variant) = self.definition()?.variant {
            method += &format!(", {} {}", variant.key, self.variant()?);
        }
        if let Some(count) = self.agent.get("candidates").and_then(Value::as_integer) {
            method += &format!(", {}", counted(count as usize, "candidate"));
        }
        Ok(method)
    }

    /// Gradient steps of the whole run.
    pub fn total_steps(&self) -> u64 {
        let online = self.online.as_ref().map_or(0, |online| online.updates_after(online.steps));
        self.steps.saturating_add(online)
    }

    /// Online environment steps that the gradient steps up to `step` wait for; `None` without
    /// online steps.
    pub fn environment_steps(&self, step: u64) -> Option<u64> {
        let online = self.online.as_ref()?;
        Some(if step > self.steps { online.rows_at(step - self.steps) } else { 0 })
    }

    /// Gradient step after which online learning begins, if others come before it.
    pub fn online_begins(&self) -> Option<u64> {
        self.online.as_ref().map(|_| self.steps).filter(|steps| *steps > 0)
    }

    /// True if evaluators have something to play: evaluations or online episodes.
    pub fn needs_evaluators(&self) -> bool {
        self.eval_interval > 0 || self.online.is_some()
    }

    /// The gradient steps and evaluations.
    pub fn schedule(&self) -> Schedule {
        let start = if self.from.is_some() { self.steps } else { 0 };
        Schedule { start, steps: self.total_steps(), eval_interval: self.eval_interval }
    }

    /// The values that distinguish runs, in one line.
    pub fn summary(&self) -> Result<String, ConfigError> {
        let (method, seed, steps) = (self.method()?, self.seed, self.steps);
        let batch_size = self.batch_size;
        let evaluations = match self.eval_interval {
            0 => "no evaluations".to_owned(),
            interval => format!("{} episodes every {interval}", self.episodes),
        };
        let online = self.online.as_ref().map_or(String::new(), |online| {
            let Online { steps, updates_per_step, .. } = online;
            format!(", then {steps} environment steps with {updates_per_step} each")
        });
        Ok(format!(
            "{method}; seed {seed}, {steps} steps of batch {batch_size}{online}; {evaluations}"
        ))
    }

    /// Checks the numbers that are no hyper-parameters.
    pub(crate) fn check_ranges(&self) -> Result<(), ConfigError> {
        check_ranges(&[
            ("steps", self.steps, 0, MOST),
            ("eval_interval", self.eval_interval, 0, MOST),
            ("seed", self.seed, 0, MOST),
            ("episodes", self.episodes.into(), 1, MOST_EPISODES),
            ("batch_size", self.batch_size.into(), 1, MOST_BATCH),
        ])?;
        for size in self.sizes.into_iter().flatten() {
            check_ranges(&[("sizes", size as u64, 1, MOST_SIZE)])?;
        }
        self.online.as_ref().map_or(Ok(()), Online::check_ranges)?;
        if self.total_steps() == 0 {
            return Err(ConfigError::new(
                "a run of 0 steps without online steps learns nothing",
                "--steps N learns from the dataset alone, --online-steps N from experience too",
            ));
        }
        match self.hold_out {
            0.0..1.0 => Ok(()),
            share => Err(ConfigError::out_of_range("hold_out", share, "at least 0 and below 1")),
        }
    }

    pub(super) fn check(&mut self) -> Result<(), ConfigError> {
        self.online.take_if(|online| online.steps == 0);
        self.check_ranges()?;
        let is_odd = |c: char| c.is_whitespace() || c.is_control();
        if self.environment.is_empty() || self.environment.contains(is_odd) {
            let name = format!("{:?}", self.environment);
            return Err(ConfigError::out_of_range("environment", name, "a name without spaces"));
        }
        // Less of a batch is rounded to no row.
        let least = 0.5 / f64::from(self.batch_size);
        if let Some(share) = self.online.as_ref().and_then(|online| online.share)
            && share < least
        {
            let range = format!("from {least} to 1, for a row of experience in each batch");
            return Err(ConfigError::out_of_range("online.share", share, &range));
        }
        let (steps, interval) = (self.total_steps(), self.eval_interval);
        let evaluations = self.schedule().evaluations();
        if evaluations > MOST_EVALUATIONS {
            return Err(ConfigError::new(
                format!(
                    "{steps} steps with an evaluation every {interval} are {evaluations} evaluations"
                ),
                format!("choose a larger eval_interval, for at most {MOST_EVALUATIONS}"),
            ));
        }
        self.definition()?.check(&self.agent).map_err(|error| {
            let problem = format!("algorithm {}", self.algorithm);
            let config_error = match error {
                AgentError::NoChunks(_) => {
                    let names = hyperparameters::names_where(|algorithm| algorithm.chunks);
                    ConfigError::new(problem, format!("leave it out, or choose one of {names}"))
                }
                _ => ConfigError::keys(problem),
            };
            config_error.with_source(error)
        })
    }
}

#[cfg(test)]
mod tests;
