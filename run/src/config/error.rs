//! Settings that cannot be used.

use std::io;

use quad_algorithms::{ALGORITHMS, AgentError, Definition, Values};

const PRINT: &str = "`learner presets TASK` prints the keys that a preset may have";
const KEYS: &str = "`learner presets TASK` prints every key; on the command line --set KEY=VALUE changes one, and \
                    --agent KEY=VALUE one below [agent]";

/// A task, an algorithm or values that cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each variant is.
pub enum ConfigError {
    #[error("there is no {kind} named {name}")]
    Unknown { kind: &'static str, name: String, hint: String },
    #[error("cannot read the preset {preset}")]
    Unreadable { preset: String, source: io::Error },
    #[error("preset {preset} is not TOML")]
    NotToml { preset: String, source: toml::de::Error },
    #[error("preset {preset} cannot be used")]
    Preset { preset: String, source: Box<ConfigError> },
    #[error("these settings of {preset} cannot be used: {reason}")]
    Keys { preset: String, reason: String },
    #[error("preset {0} names neither a task nor an environment")]
    NoEnvironment(String),
    #[error("{field} is {value}, but must be {range}")]
    OutOfRange { field: &'static str, value: String, range: String },
    #[error("{0} is a hyper-parameter")]
    Hyperparameter(String),
    #[error("{0} is no hyper-parameter")]
    NoHyperparameter(String),
    #[error("online learning of {steps} environment steps ends within its warm-up of {warmup}")]
    Warmup { steps: u64, warmup: u64 },
    #[error("a run of 0 steps without online steps learns nothing")]
    NoSteps,
    #[error("{0} learns from a dataset alone, not online")]
    NotOnline(&'static str),
    #[error("{steps} steps with an evaluation every {interval} are {evaluations} evaluations")]
    Evaluations { steps: u64, interval: u64, evaluations: u64, most: u64 },
    #[error("algorithm {algorithm}")]
    Hyperparameters { algorithm: String, source: AgentError },
}

impl ConfigError {
    pub(super) fn out_of_range(field: &'static str, value: impl ToString, range: &str) -> Self {
        let (value, range) = (value.to_string(), range.to_owned());
        Self::OutOfRange { field, value, range }
    }

    pub(super) fn unknown(kind: &'static str, name: &str, hint: String) -> Self {
        let name = name.to_owned();
        Self::Unknown { kind, name, hint }
    }

    /// Tells the user how to fix it.
    pub fn hint(&self) -> String {
        match self {
            Self::Unknown { hint, .. } => hint.clone(),
            Self::Unreadable { .. } | Self::NotToml { .. } => PRINT.to_owned(),
            Self::Preset { source, .. } => source.hint(),
            Self::NoEnvironment(_) => {
                "begin the file with a line like task = \"own-data\"; `learner presets` lists all tasks".to_owned()
            }
            Self::Hyperparameter(key) => {
                format!("--agent {key}=VALUE changes it; in a file it is below [agent]")
            }
            Self::NoHyperparameter(key) => {
                format!("--set {key}=VALUE changes it; in a file it is above [agent]")
            }
            Self::Warmup { .. } => {
                "gradient steps begin after the warm-up: give more --online-steps, or a shorter warm-up by \
                 --set online.warmup=N"
                    .to_owned()
            }
            Self::NoSteps => {
                "--steps N learns from the dataset alone, --online-steps N from experience too".to_owned()
            }
            Self::NotOnline(_) => {
                let can = |algorithm: &Definition| {
                    Values::of(algorithm).for_task(None).contains_key("online")
                };
                format!("leave out --online-steps, or choose one of {}", names_where(can))
            }
            Self::Hyperparameters { source: AgentError::NoChunks(_), .. } => {
                format!("leave it out, or choose one of {}", names_where(|algorithm| algorithm.chunks))
            }
            Self::Evaluations { most, .. } => {
                format!("choose a larger eval_interval, for at most {most}")
            }
            _ => KEYS.to_owned(),
        }
    }
}

/// Names of some algorithms.
fn names_where(can: impl Fn(&Definition) -> bool) -> String {
    let algorithms = ALGORITHMS.iter().filter(|algorithm| can(algorithm));
    Vec::from_iter(algorithms.map(|algorithm| algorithm.name)).join(", ")
}

/// `did you mean a, b? ` with up to three of the names that contain the word or differ in few letters,
/// the most similar first; empty if there are none.
pub fn did_you_mean<'a>(word: &str, names: impl IntoIterator<Item = &'a str>) -> String {
    let likeness = |name| (strsim::normalized_damerau_levenshtein(word, name), name);
    let mut similar: Vec<(f64, &str)> = names.into_iter().map(likeness).collect();
    similar.retain(|(likeness, name)| *likeness > 0.6 || name.contains(word));
    similar.sort_by(|a, b| b.0.total_cmp(&a.0));
    let names: Vec<&str> = similar.into_iter().take(3).map(|(_, name)| name).collect();
    match names.is_empty() {
        true => String::new(),
        false => format!("did you mean {}? ", names.join(", ")),
    }
}
