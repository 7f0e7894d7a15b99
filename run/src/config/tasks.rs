//! Tasks by name: the table `presets/tasks.toml`, and those that benchmarks name by a rule.

use std::sync::LazyLock;

use quad_dataset::benchmarks::{self, Benchmark, BenchmarkTask};
use quad_dataset::catalog;
use serde::Deserialize;
use toml::Table;

use super::error::{ConfigError, did_you_mean};

/// A learning task: an environment and a dataset under one name.
#[derive(Debug, Deserialize)]
pub struct Task {
    /// Name on the command line and in files.
    pub name: String,
    /// Remark in the list of tasks.
    #[serde(default)]
    pub about: String,
    /// Benchmark that has it.
    #[serde(skip)]
    pub benchmark: Option<&'static Benchmark>,
    /// True if the list of tasks shows it; a similar task stands for the others.
    #[serde(default = "yes")]
    pub is_listed: bool,
    /// The task whose values of algorithms apply, if not its own.
    #[serde(default)]
    values: Option<String>,
    /// Keys of an experiment that no algorithm changes, among them `environment` and `dataset`.
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
    let listed = tasks.task.into_iter().map(|task| {
        let benchmark =
            task.text("dataset").and_then(catalog::find).map(|dataset| dataset.benchmark);
        Task { benchmark, ..task }
    });
    listed.chain(benchmarks::tasks().map(Task::from)).collect()
});

impl From<BenchmarkTask> for Task {
    fn from(task: BenchmarkTask) -> Self {
        let mut keys = Table::new();
        keys.insert("environment".to_owned(), task.environment.into());
        let mut about = "likewise; its data needs quad-convert";
        if task.maze.is_some() {
            keys.insert("dataset".to_owned(), task.dataset.into());
            about = "the default of -task1 to -task5";
        }
        Self {
            name: task.name,
            about: about.to_owned(),
            benchmark: Some(task.benchmark),
            is_listed: task.is_default,
            values: None,
            keys,
        }
    }
}

impl Task {
    /// The task whose values of algorithms apply.
    pub fn values_task(&self) -> &str {
        self.values.as_deref().unwrap_or(&self.name)
    }

    /// The value of a key, if it is text.
    pub fn text(&self, key: &str) -> Option<&str> {
        self.keys.get(key)?.as_str()
    }
}

/// All tasks, in the order of their list.
pub fn list() -> &'static [Task] {
    &TASKS
}

/// Finds a task by name.
pub fn named(name: &str) -> Result<&'static Task, ConfigError> {
    let task = list().iter().find(|task| task.name == name);
    task.ok_or_else(|| ConfigError::unknown("task", name, unknown_hint(name)))
}

/// The hint for an unknown task: similar names.
pub fn unknown_hint(name: &str) -> String {
    did_you_mean(name, list().iter().map(|task| &*task.name)) + "`learner presets` lists all tasks"
}
