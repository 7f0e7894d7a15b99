//! From a preset and flags to one validated experiment, and what a run saves of it.

use std::path::{Path, PathBuf};

use quad_dataset::RewardRule;
use quad_policy::Precision;
use serde::{Deserialize, Serialize};

use crate::agent::{self, AgentConfig, Guidance};
use crate::device::Device;

/// The presets that the binary carries: name and TOML.
pub const PRESETS: [(&str, &str); 2] = [
    ("hopper-demo", include_str!("../../presets/hopper-demo.toml")),
    ("hopper-medium-replay-v2", include_str!("../../presets/hopper-medium-replay-v2.toml")),
];

/// The kinds of guidance and what they are called on the command line and in files.
pub const GUIDANCE: [(&str, Guidance); 3] =
    [("quad", Guidance::Quad), ("dac", Guidance::Dac), ("none", Guidance::None)];

/// The kind of guidance of that name.
pub fn guidance_named(name: &str) -> Option<Guidance> {
    GUIDANCE.iter().find(|(known, _)| *known == name).map(|(_, guidance)| *guidance)
}

/// What a kind of guidance is called.
pub fn guidance_name(guidance: Guidance) -> &'static str {
    GUIDANCE.iter().find(|(_, known)| *known == guidance).map_or("?", |(name, _)| name)
}

/// Most episodes in one evaluation, and most candidates per state: far above any use, low enough for evaluators' memory.
const MOST_EPISODES: u32 = 10_000;
const MOST_CANDIDATES: u32 = 1_000;

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
    /// Hyper-parameters of the update.
    pub agent: AgentConfig,
}

/// Values from the command line that take the place of a preset's.
#[derive(Clone, Debug, Default)]
#[allow(missing_docs)] // the fields of `Experiment` and `AgentConfig` of the same names
pub struct Overrides {
    pub steps: Option<u64>,
    pub eval_interval: Option<u64>,
    pub episodes: Option<u32>,
    pub seed: Option<u64>,
    pub guidance: Option<Guidance>,
    pub samples: Option<usize>,
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
    /// Mean D4RL-normalised score of the trajectories.
    pub mean_score: f64,
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
    /// A hyper-parameter outside its range.
    #[error(transparent)]
    Agent(#[from] agent::ConfigError),
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
        set(&mut self.agent.guidance, overrides.guidance);
        set(&mut self.agent.samples, overrides.samples);
        set(&mut self.agent.precision, overrides.precision);
    }

    /// The figures that tell runs apart, in one line.
    pub fn summary(&self) -> String {
        let Self { steps, eval_interval, episodes, candidates, seed, agent, .. } = self;
        let AgentConfig { hidden, critics, batch_size, samples, .. } = agent;
        let guidance = guidance_name(agent.guidance);
        let evaluations = match eval_interval {
            0 => "no evaluations".to_owned(),
            _ => format!("{episodes} episodes with {candidates} candidates every {eval_interval}"),
        };
        format!(
            "guidance {guidance}, seed {seed}, {steps} steps of batch {batch_size}, {samples} samples, {critics} critics, \
             {hidden} wide; {evaluations}"
        )
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
        Ok(self.agent.validate()?)
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
        let agent = &paper.agent;
        assert_eq!((agent.diffusion_steps, agent.critics, agent.batch_size, agent.hidden), (5, 10, 256, 256));
        assert_eq!((agent.rho, agent.tau, agent.eta.threshold), (1.5, 0.1, Some(1.0)));
        assert_eq!((agent.actor_learning_rate, agent.critic_learning_rate, agent.ema_rate), (3e-4, 3e-4, 5e-3));
        assert_eq!((paper.steps, paper.eval_interval, paper.episodes, paper.candidates), (2_000_000, 20_000, 10, 10));
    }

    #[test]
    fn flags_override_the_preset() {
        let overrides = Overrides {
            steps: Some(5),
            eval_interval: Some(0),
            guidance: Some(Guidance::None),
            samples: Some(7),
            ..Overrides::default()
        };
        let preset = resolve("hopper-demo", &Overrides::default()).unwrap();
        let resolved = resolve("hopper-demo", &overrides).unwrap();
        assert_eq!((resolved.steps, resolved.eval_interval, resolved.seed), (5, 0, preset.seed));
        assert_eq!((resolved.agent.guidance, resolved.agent.samples), (Guidance::None, 7));
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
        assert!(matches!(resolve("hopper-demo", &samples), Err(ConfigError::Agent(_))));
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
