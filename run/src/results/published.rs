//! Scores that others publish for tasks: the files in `published/`, the QUAD paper's first.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use quad_dataset::ogbench::is_ogbench;
use serde::{Deserialize, Serialize};

/// What a method is published to score on a task.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Published {
    /// The method, as its source calls it.
    pub method: &'static str,
    /// Its D4RL-normalized score, or its rate of success in percent.
    pub score: Printed,
    /// Where it stands.
    pub source: &'static str,
    /// The tables that have the method.
    #[serde(skip)]
    pub tables: &'static [String],
    /// How such figures are made, in a sentence.
    #[serde(skip)]
    pub protocol: &'static str,
    /// What the figure does not show.
    pub remarks: Vec<Remark>,
}

/// What is known to be wrong or peculiar of a figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Remark {
    /// What it is, in words.
    pub reason: &'static str,
    /// The figure with which the reason ends, if it ends with one.
    pub instead: Option<f64>,
    /// Whether the figure is the best of several, by the very returns that it reports.
    pub selected: bool,
}

/// A figure as it is printed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Printed {
    /// The mean over seeds.
    pub mean: f64,
    /// What stands behind its ±, if it has one. Its source may not say which convention that
    /// follows.
    pub std: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Tables {
    /// Training seeds behind a figure.
    seeds: usize,
    /// Evaluations at a run's end whose mean is the run's score.
    last: usize,
    protocol: String,
    method: Vec<Method>,
    /// Scores by task and method: the mean, and where there is one the deviation.
    scores: BTreeMap<String, BTreeMap<String, Vec<f64>>>,
    remark: Vec<KnownRemark>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Method {
    name: String,
    source: String,
    tables: Vec<String>,
    /// Ours of that method, and its variant.
    algorithm: Option<String>,
    variant: Option<String>,
}

/// A remark on figures of some methods.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct KnownRemark {
    methods: Vec<String>,
    /// How the names of its tasks begin; empty: any task.
    #[serde(default)]
    tasks: Vec<String>,
    /// The figure with which the reason ends, by task; empty: it ends with none.
    #[serde(default)]
    instead: BTreeMap<String, f64>,
    reason: String,
    #[serde(default)]
    selected: bool,
}

impl KnownRemark {
    /// The remark, if it is about this figure.
    fn on(&'static self, method: &str, task: &str) -> Option<Remark> {
        let is_of_task = match (self.tasks.is_empty(), self.instead.is_empty()) {
            (true, true) => true,
            (true, false) => self.instead.contains_key(task),
            (false, _) => self.tasks.iter().any(|start| task.starts_with(start)),
        };
        let is_on = is_of_task && self.methods.iter().any(|known| known == method);
        let instead = self.instead.get(task).copied();
        is_on.then_some(Remark { reason: &self.reason, instead, selected: self.selected })
    }
}

#[allow(clippy::expect_used)] // The tables are part of the program; the test here reads them.
static SOURCES: LazyLock<[Tables; 4]> = LazyLock::new(|| {
    let files = [
        include_str!("../../published/quad.toml"),
        include_str!("../../published/corl.toml"),
        include_str!("../../published/antmaze.toml"),
        include_str!("../../published/ogbench.toml"),
    ];
    files.map(|file| toml::from_str(file).expect("the embedded tables are valid"))
});

/// The sources that have a task, with its scores by method.
fn of_task(
    task: &str,
) -> impl Iterator<Item = (&'static Tables, &'static BTreeMap<String, Vec<f64>>)> {
    SOURCES.iter().filter_map(move |tables| Some((tables, tables.scores.get(task)?)))
}

/// What is published for a task, the paper's own method first; nothing for tasks that no source
/// has.
pub fn scores(task: &str) -> Vec<Published> {
    let of_source = |(tables, scores): (&'static Tables, &'static BTreeMap<String, Vec<f64>>)| {
        tables.method.iter().filter_map(
            move |Method { name, source, tables: of_method, .. }| {
                let figures = scores.get(name)?;
                let score = Printed { mean: *figures.first()?, std: figures.get(1).copied() };
                let remarks =
                    tables.remark.iter().filter_map(|known| known.on(name, task)).collect();
                Some(Published {
                    method: name,
                    score,
                    source,
                    tables: of_method,
                    protocol: &tables.protocol,
                    remarks,
                })
            },
        )
    };
    of_task(task).flat_map(of_source).collect()
}

/// How many training seeds stand behind a figure for the task; a single one where nothing is
/// published.
pub fn seeds(task: &str) -> usize {
    of_task(task).next().map_or(1, |(tables, _)| tables.seeds)
}

/// How many evaluations at a run's end have the mean that is its score. Where nothing is published,
/// it is FQL's authors' number in OGBench, else the QUAD paper's.
pub fn last(task: &str) -> usize {
    let [paper, .., of_ogbench] = &*SOURCES;
    let unpublished = if is_ogbench(task) { of_ogbench } else { paper };
    of_task(task).next().map_or(unpublished.last, |(tables, _)| tables.last)
}

/// The tables in which runs of an algorithm stand: those of the task that have the algorithm, or
/// else the first of the task.
pub fn tables(task: &str, algorithm: &str) -> Vec<&'static str> {
    let figures = scores(task);
    // A table has the task if one of its figures is in no other.
    let of_task = |table: &&str| figures.iter().any(|figure| figure.tables == [*table]);
    let all = Vec::from_iter(all_tables().into_iter().filter(of_task));
    let has_it = |table: &&str| {
        let is_it = |method: &&Method| method.algorithm.as_deref() == Some(algorithm);
        all_methods().filter(is_it).any(|method| method.tables.iter().any(|one| one == table))
    };
    let with_it = Vec::from_iter(all.iter().copied().filter(has_it));
    if with_it.is_empty() { all.into_iter().take(1).collect() } else { with_it }
}

/// All tables, in their order.
pub fn all_tables() -> Vec<&'static str> {
    once_each(all_methods().flat_map(|method| &method.tables).map(String::as_str))
}

/// What sources call a variant of an algorithm: several names where one has several rows, none
/// where none has one.
pub fn methods(algorithm: &str, variant: &str) -> Vec<&'static str> {
    let is_it = |method: &&Method| {
        method.algorithm.as_deref() == Some(algorithm)
            && method.variant.as_deref().is_none_or(|known| known == variant)
    };
    once_each(all_methods().filter(is_it).map(|method| &*method.name))
}

fn all_methods() -> impl Iterator<Item = &'static Method> {
    SOURCES.iter().flat_map(|tables| &tables.method)
}

/// Names in their order, none twice.
pub fn once_each<'a>(names: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut known = Vec::new();
    for name in names {
        if !known.contains(&name) {
            known.push(name);
        }
    }
    known
}

#[cfg(test)]
mod tests;
