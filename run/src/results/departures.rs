//! Differences between runs of a task with published scores and the runs of their algorithm's
//! authors.

use std::collections::BTreeSet;

use quad_dataset::catalog;

use super::published;
use super::report::{RunReport, Select};
use crate::config::settings::{self, Settings, differences_in_brief};
use crate::config::{self, ConfigError, Experiment, hyperparameters, tasks};

/// Lists the differences between runs that differ only in their seed and their authors' settings.
/// `scored_in` is the precision of their scores.
pub fn departures(runs: &[&RunReport], scored_in: &str, select: Select) -> Vec<String> {
    let Some(run) = runs.first() else { return Vec::new() };
    let ours = &run.config.experiment;
    let Ok(task) = tasks::named(&run.config.run.task) else { return Vec::new() };
    // The authors' variant applies if they publish scores of it.
    let has_row = !published::methods(&run.algorithm, &run.variant).is_empty();
    let Ok(paper) = as_given(run, has_row) else { return Vec::new() };
    let mut departures = Vec::new();
    if select == Select::Best {
        let last = published::final_evaluations(&run.config.run.task);
        let best = format!("the best evaluation of each run, not the mean of its last {last}");
        departures.push(best);
    }
    let definition = ours.definition().ok();
    departures
        .extend(definition.and_then(|definition| hyperparameters::not_given(&definition, task)));
    if let Some(theirs) = paper.dataset.first().filter(|theirs| !is_trained_on(run, theirs)) {
        let names = ours.dataset.join(", ");
        departures.push(format!("dataset is {names}, not {theirs}"));
    }
    let (ours, paper) = (without_seed(ours), without_seed(&paper));
    let keys: BTreeSet<&String> = differences_in_brief(&ours, &paper).collect();
    for key in keys {
        let value =
            |settings: &'_ Settings| settings.get(key).map_or("absent", String::as_str).to_owned();
        departures.push(format!("{key} is {}, not {}", value(&ours), value(&paper)));
    }
    if scored_in != "f32" {
        departures.push(format!("scored in {scored_in}, not in f32"));
    }
    let incomplete = runs.iter().filter(|run| !run.is_complete());
    let least = incomplete.min_by_key(|run| run.evaluations_complete());
    departures.extend(least.map(|run| run.how_complete()));
    let seeds = published::seeds(&run.config.run.task);
    if runs.len() < seeds {
        departures.push(format!("{} of {seeds} seeds", runs.len()));
    }
    departures
}

/// The authors' values of a run's task: of the run's variant, or of the algorithm's default.
pub fn as_given(run: &RunReport, with_variant: bool) -> Result<Experiment, ConfigError> {
    let table = |key: &str, value: toml::Value| toml::Table::from_iter([(key.to_owned(), value)]);
    let mut asked = table("algorithm", run.algorithm.as_str().into());
    let variant = run.config.experiment.definition()?.variant;
    if let Some(variant) = variant.filter(|_| with_variant) {
        let agent = table(variant.key, run.variant.as_str().into());
        asked.insert("agent".to_owned(), agent.into());
    }
    config::resolve(&run.config.run.task, &asked)
}

fn without_seed(experiment: &Experiment) -> Settings {
    let mut settings = settings::from_experiment(experiment);
    settings.remove("seed");
    settings
}

/// True if a run learned from the dataset of that name, by its hash or its name.
fn is_trained_on(run: &RunReport, dataset: &str) -> bool {
    let hash = catalog::find(dataset).and_then(|entry| entry.sha256.as_ref());
    let same_file = hash.is_some() && run.config.dataset.sha256().as_ref() == hash;
    same_file || run.config.experiment.dataset == [dataset]
}
