//! Settings of a run as keys and values, to compare runs.

use std::collections::BTreeMap;

use serde::Serialize;
use toml::Value;

use super::experiment::Experiment;
use super::run_config::RunConfig;
use super::tables;

/// Values by dotted key.
pub type Settings = BTreeMap<String, String>;

/// All settings that decide the outcome of a run.
pub fn from_run(config: &RunConfig) -> Settings {
    let mut settings = from_experiment(&config.experiment);
    let mut dataset = flat(&config.dataset);
    // Paths say nothing; known hashes say everything.
    dataset.remove("files");
    if let Some(sha256) = config.dataset.sha256() {
        dataset = Settings::from([("sha256".to_owned(), Value::from(sha256).to_string())]);
    }
    for (key, value) in dataset {
        settings.insert(format!("dataset.{key}"), value);
    }
    settings.insert("device".to_owned(), config.run.device.name().to_owned());
    settings
}

/// The settings of an experiment, without the dataset.
pub fn from_experiment(experiment: &Experiment) -> Settings {
    let mut settings = flat(experiment);
    settings.remove("dataset");
    settings
}

fn flat(value: &impl Serialize) -> Settings {
    // Serialization cannot fail: everything was read from TOML.
    let table = toml::Table::try_from(value).unwrap_or_default();
    tables::keys(&table).into_iter().map(|(key, value)| (key, value.to_string())).collect()
}

/// The keys at which two settings differ.
pub fn differences<'a>(a: &'a Settings, b: &'a Settings) -> impl Iterator<Item = &'a String> {
    let keys = a.keys().chain(b.keys().filter(|key| !a.contains_key(*key)));
    keys.filter(|key| a.get(*key) != b.get(*key))
}

/// The keys at which two settings differ; of online learning that only one of them has, its steps alone.
pub fn differences_in_brief<'a>(
    a: &'a Settings,
    b: &'a Settings,
) -> impl Iterator<Item = &'a String> {
    const STEPS: &str = "online.steps";
    let both_online = a.contains_key(STEPS) == b.contains_key(STEPS);
    differences(a, b).filter(move |key| both_online || *key == STEPS || !key.starts_with("online."))
}
