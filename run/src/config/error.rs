//! Settings that cannot be used.

use std::error::Error;
use std::fmt::Display;

const KEYS: &str = "`learner presets TASK` prints every key; on the command line --set KEY=VALUE changes one, and \
                    --agent KEY=VALUE one below [agent]";

/// A task, an algorithm or values that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{problem}")]
pub struct ConfigError {
    problem: String,
    hint: String,
    source: Option<Box<dyn Error + Send + Sync>>,
}

impl ConfigError {
    pub(super) fn new(problem: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { problem: problem.into(), hint: hint.into(), source: None }
    }

    /// A problem that the keys of an experiment solve.
    pub(super) fn keys(problem: String) -> Self {
        Self::new(problem, KEYS)
    }

    pub(super) fn out_of_range(field: &str, value: impl Display, range: &str) -> Self {
        Self::keys(format!("{field} is {value}, but must be {range}"))
    }

    pub(super) fn unknown(kind: &str, name: &str, hint: String) -> Self {
        Self::new(format!("there is no {kind} named {name}"), hint)
    }

    pub(super) fn with_source(self, source: impl Error + Send + Sync + 'static) -> Self {
        Self { source: Some(Box::new(source)), ..self }
    }

    /// Tells the user how to fix it.
    pub fn hint(&self) -> String {
        self.hint.clone()
    }
}

/// Checks numbers: name, value, smallest and largest value of each.
pub(super) fn check_ranges(numbers: &[(&str, u64, u64, u64)]) -> Result<(), ConfigError> {
    for (field, value, least, most) in numbers {
        if !(least..=most).contains(&value) {
            let range = format!("from {least} to {most}");
            return Err(ConfigError::out_of_range(field, value, &range));
        }
    }
    Ok(())
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
