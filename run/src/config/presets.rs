//! Presets: a task by name, or a file of the user's own.
//!
//! A file has keys of an experiment. It may name a `task`, whose values apply where the file has
//! none, and the `algorithm`.

use std::path::Path;

use quad_algorithms::{ALGORITHMS, Definition, Values, in_words};
use quad_dataset::environment;
use serde::Deserialize;
use toml::{Table, Value};

use super::error::ConfigError;
use super::experiment::Experiment;
use super::hyperparameters;
use super::run_config::RunConfig;
use super::tables::{keys, merge};
use super::tasks::{self, Task};

const PRINT: &str = "`learner presets TASK` prints the keys that a preset may have";

/// A task, or a file that may change one.
pub struct Preset {
    /// The task's name, or the file's without folder and extension; part of the names of runs.
    pub label: String,
    /// The task, if the preset names one.
    pub task: Option<&'static Task>,
    /// The file's keys; empty for a task by name.
    own: Table,
}

impl Preset {
    /// Reads a preset: the name of a task, or a path that ends in `.toml`.
    pub fn read(preset: &str) -> Result<Self, ConfigError> {
        if !is_path(preset) {
            let task = tasks::named(preset)?;
            let (label, own) = (task.name.clone(), Table::new());
            let task = Some(task);
            return Ok(Self { label, task, own });
        }
        let error = |problem| ConfigError::new(problem, PRINT);
        let text = std::fs::read_to_string(preset).map_err(|source| {
            error(format!("cannot read the preset {preset}")).with_source(source)
        })?;
        let mut own: Table = text.parse().map_err(|source: toml::de::Error| {
            error(format!("preset {preset} is not TOML")).with_source(source)
        })?;
        let task = own.remove("task").map(|task| tasks::named(&text_of(&task))).transpose();
        let task = task.map_err(|source| {
            let problem = format!("preset {preset} cannot be used");
            ConfigError::new(problem, source.hint()).with_source(source)
        })?;
        let stem = Path::new(preset).file_stem().and_then(|stem| stem.to_str());
        Ok(Self { label: stem.unwrap_or("preset").to_owned(), task, own })
    }

    /// No task: an algorithm's general values, in the environment that changes name.
    pub fn without_task(environment: &str) -> Self {
        Self { label: environment.to_owned(), task: None, own: Table::new() }
    }

    /// The settings of a run, as `own` keys.
    pub fn from_run(config: &RunConfig, own: Table) -> Result<Self, ConfigError> {
        let label = format!("{}-online", config.run.name);
        Ok(Self { label, task: tasks::named(&config.run.task).ok(), own })
    }

    /// Name of the task; the label if the file names none.
    pub fn task_name(&self) -> &str {
        self.task.map_or(&self.label, |task| &task.name)
    }

    /// Merges the algorithm's values for the task, the task's keys, the algorithm's for an
    /// online run, the file's keys and `changes`, the later over the earlier, and checks them.
    pub fn resolve(&self, changes: &Table) -> Result<Experiment, ConfigError> {
        let definition = self.algorithm(changes)?;
        let mut table = Values::read(&definition).for_task(self.task.map(Task::values_task));
        let has_online = table.contains_key("online");
        let online_values = table.remove("online_values");
        let mut task_keys = self.task.map_or_else(Table::new, |task| task.keys.clone());
        // An algorithm that learns from experience alone does so in each task.
        if table.get("steps") == Some(&Value::Integer(0)) {
            task_keys.remove("steps");
        }
        merge(&mut table, task_keys);
        if let Some(Value::Table(values)) = online_values
            && [changes, &self.own].into_iter().find_map(online_steps).is_some_and(|n| n > 0)
        {
            merge(&mut table, values);
        }
        merge(&mut table, self.own.clone());
        check_places(&table, changes)?;
        merge(&mut table, changes.clone());
        table.insert("algorithm".to_owned(), definition.name.into());
        if table.contains_key("online") && !has_online {
            let can =
                |other: &Definition| Values::read(other).for_task(None).contains_key("online");
            let names = hyperparameters::names_where(can);
            return Err(ConfigError::new(
                format!("{} learns from a dataset alone, not online", definition.name),
                format!("leave out --online-steps, or choose one of {names}"),
            ));
        }
        let Some(environment) = table.get("environment") else {
            return Err(ConfigError::new(
                format!("preset {} names neither a task nor an environment", self.label),
                "begin the file with a line like task = \"own-data\"; `learner presets` lists all tasks",
            ));
        };
        if !table.contains_key("reward") {
            let has_data = definition.needs_data || table.contains_key("dataset");
            let rule = has_data.then(|| environment::reward_rule(&text_of(environment)));
            let rule = Value::try_from(rule.unwrap_or_default());
            table.extend(rule.map(|rule| ("reward".to_owned(), rule)));
        }
        let mut experiment = Experiment::deserialize(table).map_err(|error| {
            let (preset, reason) = (&self.label, in_words(&error));
            ConfigError::keys(format!("these settings of {preset} cannot be used: {reason}"))
        })?;
        experiment.check()?;
        Ok(experiment)
    }

    /// Warnings about the experiment that `changes` resolve to: the algorithm's authors give no values
    /// for the task, a change has no effect, or the policy does not learn.
    pub fn doubts(
        &self,
        experiment: &Experiment,
        changes: &Table,
    ) -> Result<Vec<String>, ConfigError> {
        let definition = experiment.definition()?;
        let not_given = self.task.and_then(|task| hyperparameters::not_given(&definition, task));
        let mut doubts = Vec::from_iter(not_given);
        let changed = Vec::from_iter(keys(changes).into_iter().map(|(key, _)| key));
        if let Some(variant) = definition.variant {
            let (key, value) = (variant.key, experiment.variant()?);
            for unused in (variant.unused)(value).iter().map(|key| format!("agent.{key}")) {
                if changed.contains(&unused) {
                    doubts.push(format!("{unused} has no effect on a policy with {key} {value}"));
                }
            }
        }
        for (name, network) in experiment.agent.iter() {
            let has_norm = network.get("norm").and_then(Value::as_bool).unwrap_or(false);
            for unused in ["norm_after", "norm_epsilon"].map(|key| format!("agent.{name}.{key}")) {
                if !has_norm && changed.contains(&unused) {
                    doubts.push(format!("{unused} has no effect without agent.{name}.norm = true"));
                }
            }
        }
        let is_online = |key: &&String| key.starts_with("online.") && *key != "online.steps";
        for unused in changed.iter().filter(|key| experiment.online.is_none() && is_online(key)) {
            doubts.push(format!("{unused} has no effect without online steps (--online-steps N)"));
        }
        if experiment.dataset.is_empty()
            && !definition.needs_data
            && changes.contains_key("hold_out")
        {
            doubts.push("hold_out has no effect without a dataset (--dataset)".to_owned());
        }
        let steps = experiment.total_steps();
        if let Some(key) = definition.acts_after
            && let Some(start) = experiment.agent.get(key).and_then(Value::as_integer)
            && steps <= start as u64
        {
            doubts.push(format!(
                "the target actor, which acts, stays as it began: it moves after step {start} (agent.{key}), and this run has {steps}"
            ));
        }
        Ok(doubts)
    }

    /// The algorithm of the changes, else of the file, else the first of all.
    fn algorithm(&self, changes: &Table) -> Result<Definition, ConfigError> {
        match changes.get("algorithm").or(self.own.get("algorithm")) {
            Some(name) => hyperparameters::algorithm(&text_of(name)),
            None => Ok(ALGORITHMS[0]),
        }
    }
}

/// The online environment steps that keys name.
fn online_steps(keys: &Table) -> Option<i64> {
    keys.get("online")?.get("steps")?.as_integer()
}

/// Refuses a change above `[agent]` to a key that `table` has below it, and the reverse.
fn check_places(table: &Table, changes: &Table) -> Result<(), ConfigError> {
    let agent = |table: &Table| table.get("agent").and_then(Value::as_table).cloned();
    let [below, below_changes] = [table, changes].map(|table| agent(table).unwrap_or_default());
    let misplaced = |changes: &Table, here: &Table, there: &Table| {
        let is_misplaced = |key: &&String| !here.contains_key(*key) && there.contains_key(*key);
        changes.keys().find(is_misplaced).cloned()
    };
    if let Some(key) = misplaced(changes, table, &below) {
        return Err(ConfigError::new(
            format!("{key} is a hyper-parameter"),
            format!("--agent {key}=VALUE changes it; in a file it is below [agent]"),
        ));
    }
    if let Some(key) = misplaced(&below_changes, &below, table) {
        return Err(ConfigError::new(
            format!("{key} is no hyper-parameter"),
            format!("--set {key}=VALUE changes it; in a file it is above [agent]"),
        ));
    }
    Ok(())
}

/// True if a preset is the path of a file, not the name of a task.
pub fn is_path(preset: &str) -> bool {
    preset.ends_with(".toml")
}

/// The value as text, without quotes.
fn text_of(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// Reads a preset and [resolves](Preset::resolve) it with changes.
pub fn resolve(preset: &str, changes: &Table) -> Result<Experiment, ConfigError> {
    Preset::read(preset)?.resolve(changes)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The algorithm's values online apply to the whole run, and the user's over them.
    #[test]
    fn an_online_run_has_values_of_its_own() {
        let task = "humanoidmaze-medium-navigate-singletask-v0";
        for (changes, alpha) in [
            ("", 30.0),
            ("online.steps = 0", 30.0),
            ("online.steps = 9", 100.0),
            ("online.steps = 9\nagent.alpha = 7", 7.0),
        ] {
            let changes: Table = format!("algorithm = 'fql'\n{changes}").parse().unwrap();
            let experiment = resolve(task, &changes).unwrap();
            assert_eq!(experiment.agent["alpha"].as_float(), Some(alpha), "{changes}");
        }
        let own = "algorithm = 'fql'\nonline.steps = 9".parse().unwrap();
        let file = Preset { label: "file".to_owned(), task: tasks::named(task).ok(), own };
        let experiment = file.resolve(&Table::new()).unwrap();
        assert_eq!(experiment.agent["alpha"].as_float(), Some(100.0), "a user's file asks");
        let changes: Table = "algorithm = 'cql'\nonline.steps = 9".parse().unwrap();
        let experiment = resolve("antmaze-medium-play-v2", &changes).unwrap();
        assert_eq!((experiment.steps, experiment.episodes), (1_000_000, 20));
        assert_eq!(experiment.agent["threshold"].as_float(), Some(0.8));
        assert_eq!(experiment.agent["phases"]["cloning"].as_integer(), Some(0));
    }

    #[test]
    fn doubts_name_changes_without_effect_and_an_actor_that_does_not_move() {
        let preset = Preset::read("hopper-demo").unwrap();
        // An unnamed τ of the task has no doubt, nor has DQL, whose actor acts, not the target actor.
        for line in include_str!("presets/doubts.txt").lines() {
            let (changes, expected) = line.split_once(" =>").unwrap();
            let changes: Table = changes.replace("\\n", "\n").parse().unwrap();
            let experiment = preset.resolve(&changes).unwrap();
            let doubts = preset.doubts(&experiment, &changes).unwrap();
            assert_eq!(doubts.join("; "), expected.trim_start(), "{changes}");
        }
    }
}
