//! What a user can begin from: a task by name, or a file of the user's own.
//!
//! A file has keys of an experiment. It may also name a `task`, whose values hold where it says
//! nothing, and says by `algorithm` whose values these are.

use std::path::Path;

use anyhow::{Context, anyhow};
use quad_algorithms::{ALGORITHMS, Definition, Values};
use quad_dataset::{RewardRule, environment, ogbench};
use quad_runtime::Hint;
use toml::{Table, Value};

use super::experiment::{Experiment, KEYS};
use super::hyperparameters;
use super::tables::merge;
use super::tasks::{self, Task};

const PRINT: &str = "`learner presets TASK` prints what such a file may have";

/// A task, or a file that may change one.
pub struct Preset {
    /// What it is called in the names of runs: the task's name, or the file's without its folder
    /// and ending.
    pub label: String,
    /// The task, if there is one.
    pub task: Option<&'static Task>,
    /// What the file says; nothing for a task by name.
    own: Table,
}

impl Preset {
    /// Reads a preset: the name of a task, or a path that ends in `.toml`.
    ///
    /// # Errors
    /// There is no such task, the file cannot be read, or it is not TOML.
    pub fn read(preset: &str) -> anyhow::Result<Self> {
        if !is_path(preset) {
            let task = tasks::named(preset)?;
            return Ok(Self { label: task.name.clone(), task: Some(task), own: Table::new() });
        }
        let text = std::fs::read_to_string(preset)
            .with_context(|| format!("cannot read the preset {preset}"))
            .hint(PRINT)?;
        let mut own: Table =
            text.parse().with_context(|| format!("preset {preset} is not TOML")).hint(PRINT)?;
        let task = own.remove("task").map(|name| tasks::named(&word(&name))).transpose();
        let stem = Path::new(preset).file_stem().and_then(|stem| stem.to_str());
        Ok(Self {
            label: stem.unwrap_or("preset").to_owned(),
            task: task.with_context(|| format!("preset {preset} cannot be used"))?,
            own,
        })
    }

    /// Name of the task; of a file that names none, its label.
    pub fn task_name(&self) -> &str {
        self.task.map_or(&self.label, |task| &task.name)
    }

    /// The values of the task for the algorithm, the file's and then the changes laid over them,
    /// all checked.
    ///
    /// # Errors
    /// There is no such algorithm, or something in the file or in the changes cannot be used.
    pub fn resolve(&self, changes: &Table) -> anyhow::Result<Experiment> {
        let label = &self.label;
        let definition = self.algorithm(changes)?;
        let mut table = Values::of(&definition)?.for_task(self.task.map(Task::valued_as));
        for keys in self.task.map(|task| &task.keys).into_iter().chain([&self.own, changes]) {
            merge(&mut table, keys.clone());
        }
        table.insert("algorithm".to_owned(), definition.name.into());
        let Some(named) = table.get("environment") else {
            return Err(anyhow!("preset {label} names neither a task nor an environment"))
                .hint("begin the file with a line like task = \"own-data\"; `learner presets` lists all tasks");
        };
        if !table.contains_key("reward") {
            let rule =
                named.as_str().map_or(RewardRule::AsIs, |name| match environment::find(name) {
                    Ok(spec) => spec.reward,
                    Err(_) if ogbench::maze_task(name).is_some() => RewardRule::Subtract1,
                    Err(_) => RewardRule::AsIs,
                });
            table.insert("reward".to_owned(), Value::try_from(rule)?);
        }
        let experiment: Experiment = table
            .try_into()
            .with_context(|| format!("preset {label} cannot be used"))
            .hint(KEYS)?;
        experiment.validate()?;
        Ok(experiment)
    }

    /// The algorithm that the changes name, or the file, or the first of all.
    fn algorithm(&self, changes: &Table) -> anyhow::Result<Definition> {
        let name = changes.get("algorithm").or_else(|| self.own.get("algorithm"));
        name.map_or(Ok(ALGORITHMS[0]), |name| hyperparameters::algorithm(&word(name)))
    }
}

/// Whether this is the path of a user's own file rather than the name of a task.
pub fn is_path(preset: &str) -> bool {
    preset.ends_with(".toml")
}

/// A word of a file, or what stands there in its place.
fn word(value: &Value) -> String {
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

/// Reads a preset (the name of a task, or a path that ends in `.toml`), lays changes over it,
/// checks every range. The changes may name another `algorithm` than the preset.
///
/// # Errors
/// There is no such preset, or something in it or in the changes cannot be used.
pub fn resolve(preset: &str, changes: &Table) -> anyhow::Result<Experiment> {
    Preset::read(preset)?.resolve(changes)
}
