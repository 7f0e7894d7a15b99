//! Tasks by name: the table `presets/tasks.toml`, and OGBench's.

use std::sync::LazyLock;

use anyhow::anyhow;
use quad_dataset::ogbench::{self, TaskNames};
use quad_runtime::hinted;
use serde::Deserialize;
use toml::Table;

use super::nearest::did_you_mean;

/// What is to be learned, whichever algorithm learns it.
#[derive(Debug, Deserialize)]
pub struct Task {
    /// What it is called on the command line and in files.
    pub name: String,
    /// A few words for the list of tasks; empty where environment and dataset say it.
    #[serde(default)]
    pub about: String,
    /// Whether the list of tasks has it; else another says that there are more like it.
    #[serde(default = "yes")]
    pub is_listed: bool,
    /// The task of which algorithms' values are taken, if they are not its own.
    #[serde(default)]
    values: Option<String>,
    /// Keys of an experiment that no algorithm's file changes, among them `environment`, and
    /// `dataset` if it has one.
    #[serde(flatten)]
    pub keys: Table,
}

fn yes() -> bool {
    true
}

#[derive(Deserialize)]
struct Tasks {
    task: Vec<Task>,
}

#[allow(clippy::expect_used)] // The table is part of the program; a test reads it.
static TASKS: LazyLock<Vec<Task>> = LazyLock::new(|| {
    let tasks: Tasks = toml::from_str(include_str!("../../../presets/tasks.toml"))
        .expect("the embedded table is valid");
    tasks.task.into_iter().chain(ogbench::tasks().map(Task::from)).collect()
});

impl From<TaskNames> for Task {
    fn from(TaskNames { task, environment, dataset, is_default }: TaskNames) -> Self {
        let about = match dataset {
            Some(_) => "the default of -task1 to -task5",
            None => "likewise; its data needs quad-convert",
        };
        let keys = [("environment", Some(environment)), ("dataset", dataset)];
        let keys = keys
            .into_iter()
            .filter_map(|(key, value)| Some((key.to_owned(), value?.into())))
            .collect();
        Self { name: task, about: about.to_owned(), is_listed: is_default, values: None, keys }
    }
}

impl Task {
    /// The name by which algorithms' files have its values.
    pub fn valued_as(&self) -> &str {
        self.values.as_deref().unwrap_or(&self.name)
    }

    /// The value of a key that is a word, or nothing.
    pub fn word(&self, key: &str) -> Option<&str> {
        self.keys.get(key)?.as_str()
    }
}

/// All tasks, in the order in which they are listed.
pub fn all() -> &'static [Task] {
    &TASKS
}

/// The task of that name.
///
/// # Errors
/// There is none; the hint has similar names.
pub fn named(name: &str) -> anyhow::Result<&'static Task> {
    let unknown = || hinted(anyhow!("there is no task named {name}"), unknown_hint(name));
    all().iter().find(|task| task.name == name).ok_or_else(unknown)
}

/// What to do about a name that no task has.
pub fn unknown_hint(name: &str) -> String {
    did_you_mean(name, all().iter().map(|task| &*task.name)) + "`learner presets` lists all tasks"
}
