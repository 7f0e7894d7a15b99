//! From a preset and flags to one validated experiment, and what a run saves of it.

use std::path::{Path, PathBuf};

use quad_dataset::RewardRule;
use quad_policy::Precision;
use serde::{Deserialize, Serialize};

use crate::algorithms::{self, ALGORITHMS, AgentError, Definition, Hyperparameters};
use crate::device::Device;

/// The presets that the binary carries: name and TOML.
pub const PRESETS: [(&str, &str); 3] = [
    ("hopper-demo", include_str!("../../presets/hopper-demo.toml")),
    ("hopper-demo-iql", include_str!("../../presets/hopper-demo-iql.toml")),
    ("hopper-medium-replay-v2", include_str!("../../presets/hopper-medium-replay-v2.toml")),
];

/// Most episodes in one evaluation, and most candidates per state: far above any use, low enough for evaluators' memory.
const MOST_EPISODES: u32 = 10_000;
const MOST_CANDIDATES: u32 = 1_000;
/// Most transitions in a batch: far above any use, too.
const MOST_BATCH: u32 = 1 << 20;

/// Everything that decides the outcome of a run, apart from the dataset: the contents of a preset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Environment that the data is from and the policy is evaluated in.
    pub environment: String,
    /// How rewards are scaled before training.
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
    pub agent: toml::Table,
}

/// Values from the command line that take the place of a preset's.
#[derive(Clone, Debug, Default)]
#[allow(missing_docs)] // the fields of `Experiment` and of its `agent` of the same names
pub struct Overrides {
    pub steps: Option<u64>,
    pub eval_interval: Option<u64>,
    pub episodes: Option<u32>,
    pub seed: Option<u64>,
    pub guidance: Option<String>,
    pub samples: Option<u32>,
    pub precision: Option<Precision>,
    pub candidates: Option<u32>,
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
    /// Start of the learner in milliseconds since 1970; tells it from an earlier learner of the same run.
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

/// A preset that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the preset {path}")]
    Read {
        /// Where it should be.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Neither embedded nor a path.
    #[error("there is no preset named {0}")]
    Unknown(String),
    /// Not TOML, a field too many or too few, or a wrong type.
    #[error("preset {preset}: {source}")]
    Parse {
        /// Which preset.
        preset: String,
        /// What is wrong, with the line.
        source: Box<toml::de::Error>,
    },
    /// An algorithm that nobody knows.
    #[error("there is no algorithm named {0:?}; there are {known}", known = ALGORITHMS.map(|known| known.name).join(", "))]
    Algorithm(String),
    /// A hyper-parameter that the algorithm does not have, or one outside its range.
    #[error("algorithm {algorithm}: {source}")]
    Agent {
        /// Which algorithm.
        algorithm: String,
        /// What is wrong.
        source: AgentError,
    },
    /// Candidates for a policy that samples none.
    #[error("candidates is {0}, but the policy of this algorithm does not sample any, so it must be 1")]
    Candidates(u32),
    /// Another value outside its range.
    #[error("{field} is {value}, but must be from {least} to {most}")]
    Range {
        /// Name of the field.
        field: &'static str,
        /// What it was.
        value: u64,
        /// Smallest allowed.
        least: u64,
        /// Largest allowed.
        most: u64,
    },
}

/// The TOML of an embedded preset.
pub fn embedded_preset(name: &str) -> Option<&'static str> {
    PRESETS.iter().find(|(known, _)| *known == name).map(|(_, toml)| *toml)
}

/// The short name of a preset: `hopper-demo`, also for a path like `my/hopper-demo.toml`.
pub fn preset_label(preset: &str) -> String {
    let stem = Path::new(preset).file_stem().and_then(|stem| stem.to_str());
    if preset.ends_with(".toml") { stem.unwrap_or("preset").to_owned() } else { preset.to_owned() }
}

/// Reads a preset (an embedded name, or a path that ends in `.toml`), applies the flags, checks every range.
pub fn resolve(preset: &str, overrides: &Overrides) -> Result<Experiment, ConfigError> {
    if !preset.ends_with(".toml") {
        let text = embedded_preset(preset).ok_or_else(|| ConfigError::Unknown(preset.to_owned()))?;
        return parse(preset, text, overrides);
    }
    match std::fs::read_to_string(preset) {
        Ok(text) => parse(preset, &text, overrides),
        Err(source) => Err(ConfigError::Read { path: preset.into(), source }),
    }
}

fn parse(preset: &str, text: &str, overrides: &Overrides) -> Result<Experiment, ConfigError> {
    let parsed = toml::from_str::<Experiment>(text);
    let mut experiment =
        parsed.map_err(|source| ConfigError::Parse { preset: preset.to_owned(), source: Box::new(source) })?;
    experiment.apply(overrides);
    experiment.validate()?;
    if !experiment.hyperparameters()?.samples_candidates() && experiment.candidates != 1 {
        return Err(ConfigError::Candidates(experiment.candidates));
    }
    Ok(experiment)
}

impl Experiment {
    fn apply(&mut self, overrides: &Overrides) {
        fn set<T: Copy>(field: &mut T, value: Option<T>) {
            *field = value.unwrap_or(*field);
        }
        set(&mut self.steps, overrides.steps);
        set(&mut self.eval_interval, overrides.eval_interval);
        set(&mut self.episodes, overrides.episodes);
        set(&mut self.seed, overrides.seed);
        set(&mut self.candidates, overrides.candidates);
        set(&mut self.precision, overrides.precision);
        // An algorithm without such a hyper-parameter refuses it when it reads the table.
        let guidance = overrides.guidance.clone().map(|guidance| ("guidance", guidance.into()));
        let samples = overrides.samples.map(|samples| ("samples", samples.into()));
        self.agent.extend([guidance, samples].into_iter().flatten().map(|(key, value)| (key.to_owned(), value)));
    }

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

    fn demo_with(change: impl Fn(&str) -> String) -> Result<Experiment, ConfigError> {
        parse("test", &change(embedded_preset("hopper-demo").unwrap()), &Overrides::default())
    }

    #[test]
    fn every_embedded_preset_is_valid() {
        for (name, _) in PRESETS {
            let experiment = resolve(name, &Overrides::default()).unwrap();
            let text = toml::to_string(&experiment).unwrap();
            assert_eq!(toml::from_str::<Experiment>(&text).unwrap(), experiment, "{name} survives being saved");
        }
    }

    #[test]
    fn the_papers_preset_holds_the_papers_numbers() {
        let paper = resolve("hopper-medium-replay-v2", &Overrides::default()).unwrap();
        let number =
            |key: &str| paper.agent[key].as_float().unwrap_or_else(|| paper.agent[key].as_integer().unwrap() as f64);
        let keys =
            ["diffusion_steps", "critics", "hidden", "rho", "tau", "actor_learning_rate", "critic_learning_rate"];
        assert_eq!(keys.map(number), [5.0, 10.0, 256.0, 1.5, 0.1, 3e-4, 3e-4]);
        assert_eq!(
            (number("ema_rate"), paper.agent["eta"]["threshold"].as_float(), paper.batch_size),
            (5e-3, Some(1.0), 256)
        );
        assert_eq!((paper.steps, paper.eval_interval, paper.episodes, paper.candidates), (2_000_000, 20_000, 10, 10));
    }

    #[test]
    fn flags_override_the_preset() {
        let overrides = Overrides {
            steps: Some(5),
            eval_interval: Some(0),
            guidance: Some("none".to_owned()),
            samples: Some(7),
            ..Overrides::default()
        };
        let preset = resolve("hopper-demo", &Overrides::default()).unwrap();
        let resolved = resolve("hopper-demo", &overrides).unwrap();
        assert_eq!((resolved.steps, resolved.eval_interval, resolved.seed), (5, 0, preset.seed));
        assert_eq!(
            (resolved.agent["guidance"].as_str(), resolved.agent["samples"].as_integer()),
            (Some("none"), Some(7))
        );
    }

    #[test]
    fn unknown_and_missing_fields_are_errors() {
        let unknown = demo_with(|text| format!("candidate = 3\n{text}")).unwrap_err().to_string();
        assert!(unknown.contains("candidate"), "{unknown}");
        let nested = demo_with(|text| text.replace("[agent]", "[agent]\nlearning_rte = 1.0")).unwrap_err();
        assert!(nested.to_string().contains("learning_rte"), "{nested}");
        let missing = demo_with(|text| text.replace("episodes", "# episodes")).unwrap_err();
        assert!(missing.to_string().contains("episodes"), "{missing}");
    }

    #[test]
    fn values_out_of_range_are_errors() {
        let zero = Overrides { episodes: Some(0), ..Overrides::default() };
        assert!(matches!(resolve("hopper-demo", &zero), Err(ConfigError::Range { field: "episodes", .. })));
        let huge = Overrides { seed: Some(u64::MAX), ..Overrides::default() };
        assert!(matches!(resolve("hopper-demo", &huge), Err(ConfigError::Range { field: "seed", .. })));
        let samples = Overrides { samples: Some(0), ..Overrides::default() };
        assert!(matches!(resolve("hopper-demo", &samples), Err(ConfigError::Agent { .. })));
        let guidance = Overrides { guidance: Some("sac".to_owned()), ..Overrides::default() };
        let error = resolve("hopper-demo", &guidance).unwrap_err().to_string();
        assert!(error.contains("sac") && error.contains("dac"), "the names that there are are offered: {error}");
        let error = resolve("hopper-demo-iql", &samples).unwrap_err().to_string();
        assert!(error.contains("iql") && error.contains("samples"), "{error}");
        let many = Overrides { candidates: Some(10), ..Overrides::default() };
        assert!(matches!(resolve("hopper-demo-iql", &many), Err(ConfigError::Candidates(10))));
        let unknown = demo_with(|text| text.replace("algorithm = \"quad\"", "algorithm = \"sac\"")).unwrap_err();
        assert!(unknown.to_string().contains("quad, iql"), "{unknown}");
    }

    #[test]
    fn a_path_is_read_and_a_missing_one_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mine.toml");
        std::fs::write(&path, embedded_preset("hopper-demo").unwrap()).unwrap();
        let path = path.to_str().unwrap();
        assert_eq!(resolve(path, &Overrides::default()).unwrap(), demo_with(str::to_owned).unwrap());
        assert_eq!(preset_label(path), "mine");
        let missing = resolve("nowhere/x.toml", &Overrides::default()).unwrap_err();
        assert!(missing.to_string().contains("nowhere/x.toml"), "{missing}");
    }
}
