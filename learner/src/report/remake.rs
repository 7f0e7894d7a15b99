//! The command that makes a run again.

use quad_run::config::settings::{self, differences};
use quad_run::config::tables::parse_assignment;
use quad_run::results::RunReport;
use quad_run::results::departures::as_given;

/// `learner train` with all that decides the outcome of the run. Nothing if what the run began from
/// is no task of this learner's, but a file of its user's, or lacks a value that its task has.
pub fn command(run: &RunReport) -> Option<String> {
    let experiment = &run.config.experiment;
    let given = as_given(run, false).ok()?;
    let (ours, theirs) = (settings::of_experiment(experiment), settings::of_experiment(&given));
    let mut words = vec!["learner train --task".to_owned(), quoted(&run.task)];
    let mut say = |flag: &str, value: &str| words.extend([flag.to_owned(), quoted(value)]);
    say("--algorithm", &run.algorithm);
    if let Some(dataset) = &experiment.dataset {
        say("--dataset", dataset);
    }
    if experiment.environment != given.environment {
        say("--env", &experiment.environment);
    }
    for key in
        differences(&ours, &theirs).filter(|key| !matches!(key.as_str(), "environment" | "seed"))
    {
        say("--set", &assignment(key, ours.get(key)?));
    }
    if run.config.run.device != Default::default() {
        say("--device", run.config.run.device.name());
    }
    say("--seed", &run.seed.to_string());
    say("--run-dir", &run.dir.to_string_lossy());
    Some(words.join(" "))
}

/// `KEY=VALUE`; a word goes without its quotes where that says the same.
fn assignment(key: &str, value: &str) -> String {
    let [exact, bare] = [value, value.trim_matches('"')].map(|value| format!("{key}={value}"));
    if parse_assignment(&bare) == parse_assignment(&exact) { bare } else { exact }
}

/// A word as a shell reads it.
pub fn quoted(word: &str) -> String {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "-_./=:,+".contains(c);
    if !word.is_empty() && word.chars().all(is_plain) {
        return word.to_owned();
    }
    format!("'{}'", word.replace('\'', r"'\''"))
}

#[cfg(test)]
mod tests;
