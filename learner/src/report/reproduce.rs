//! The command that reproduces a run.

use std::collections::BTreeSet;

use quad_run::config::settings::{self, differences};
use quad_run::config::tables::parse_assignment;
use quad_run::config::{ConfigError, Experiment, resolve};
use quad_run::results::RunReport;
use quad_run::results::departures::as_given;

/// `learner train` with all settings that decide the outcome of the run; a comment if it goes on from
/// another run, whose folder is not known. `None` if the run is of no task that this learner has, or
/// lacks a value of its task.
pub fn command(run: &RunReport) -> Option<String> {
    let experiment = &run.config.experiment;
    if let (Some(hash), Some(online)) = (&experiment.from, &experiment.online) {
        let (dir, steps) = (&run.dir, online.steps);
        return Some(format!(
            "# {dir:?} goes on from the run with the checkpoint {hash}: learner train --from RUN --online-steps {steps}"
        ));
    }
    let preset = as_given(run, false).ok()?;
    let mut words = vec!["learner train --task".to_owned(), quoted(&run.config.run.task)];
    let mut push = |flag: &str, value: &str| words.extend([flag.to_owned(), quoted(value)]);
    push("--algorithm", &run.algorithm);
    if let Some(dataset) = &experiment.dataset {
        push("--dataset", dataset);
    }
    if experiment.environment != preset.environment {
        push("--env", &experiment.environment);
    }
    // What follows from experience is compared with the online values.
    let played = online_values(experiment, &run.config.run.task).ok()?;
    let [ours, theirs, played] = [experiment, &preset, &played].map(settings::from_experiment);
    let keys = differences(&ours, &theirs).chain(differences(&ours, &played));
    for key in keys.collect::<BTreeSet<_>>() {
        match (key.as_str(), ours.get(key)) {
            ("environment" | "seed", _) => {}
            // A share of 0 is not among the settings, but the task may have another.
            ("hold_out", None) => push("--hold-out", "0"),
            (_, value) => push("--set", &assignment(key, value?)),
        }
    }
    if run.config.run.device != Default::default() {
        push("--device", run.config.run.device.name());
    }
    push("--seed", &run.seed.to_string());
    push("--run-dir", &run.dir.to_string_lossy());
    Some(words.join(" "))
}

/// The values of an experiment's algorithm for a task with as many online steps.
fn online_values(experiment: &Experiment, task: &str) -> Result<Experiment, ConfigError> {
    let algorithm = experiment.algorithm.as_str();
    let steps = experiment.online.as_ref().map_or(0, |online| online.steps) as i64;
    resolve(task, &toml::toml! { algorithm = algorithm online.steps = steps })
}

/// `KEY=VALUE`, without quotes where they can be omitted.
fn assignment(key: &str, value: &str) -> String {
    let [exact, bare] = [value, value.trim_matches('"')].map(|value| format!("{key}={value}"));
    if parse_assignment(&bare) == parse_assignment(&exact) { bare } else { exact }
}

/// Quotes a word for a shell.
pub fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests;
