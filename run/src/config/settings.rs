//! What decides the outcome of a run, key by key: by it a run is compared with others, and with
//! itself when it continues.

use std::collections::BTreeMap;

use serde::Serialize;

use super::experiment::Experiment;
use super::run_config::RunConfig;
use super::tables;

/// Values by dotted key.
pub type Settings = BTreeMap<String, String>;

/// Everything that decides the outcome of a run, the seed included.
pub fn of_run(config: &RunConfig) -> Settings {
    let mut settings = of_experiment(&config.experiment);
    let mut dataset = flat(&config.dataset);
    // The same file may lie in several places. Where the hash of its contents is known, it says
    // all.
    dataset.remove("path");
    if dataset.contains_key("sha256") {
        dataset.retain(|key, _| key == "sha256");
    }
    settings.extend(dataset.into_iter().map(|(key, value)| (format!("dataset.{key}"), value)));
    settings.insert("device".to_owned(), config.run.device.name().to_owned());
    settings
}

/// What is set, but for the name of the dataset, which says less than its contents.
pub fn of_experiment(experiment: &Experiment) -> Settings {
    let mut settings = flat(experiment);
    settings.remove("dataset");
    settings
}

fn flat(value: &impl Serialize) -> Settings {
    // Everything here was read from TOML, so it can be written.
    let table = toml::Table::try_from(value).unwrap_or_default();
    tables::keys(&table).into_iter().map(|(key, value)| (key, value.to_string())).collect()
}

/// The keys at which two settings differ, in alphabetical order for each of them.
pub fn differences<'a>(a: &'a Settings, b: &'a Settings) -> impl Iterator<Item = &'a String> {
    a.keys()
        .chain(b.keys().filter(|key| !a.contains_key(*key)))
        .filter(|key| a.get(*key) != b.get(*key))
}
