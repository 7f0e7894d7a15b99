//! Published scores of tasks: the files in `published/`, the QUAD paper's first.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::LazyLock;

use quad_algorithms::fits;
use serde::{Deserialize, Serialize};

use crate::config::tasks;

/// The published score of a method on a task.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Published {
    /// Name of the method in its source.
    pub method: &'static str,
    /// D4RL-normalized score, or rate of success in percent.
    pub score: Printed,
    /// Paper or repository that has the score.
    pub source: &'static str,
    /// Tables that contain the method.
    #[serde(skip)]
    pub tables: &'static [String],
    /// The source's protocol of evaluation, in a sentence.
    #[serde(skip)]
    pub protocol: &'static str,
    /// Known peculiarities of the score.
    pub remarks: Vec<Remark>,
}

/// A known error or peculiarity of a score.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Remark {
    /// Text of the footnote.
    pub reason: &'static str,
    /// The figure at the end of the explanation, if it ends with one.
    pub instead: Option<f64>,
    /// True if the score is the best of several, selected by the reported returns.
    pub selected: bool,
}

/// A score as it is printed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Printed {
    /// Mean over seeds.
    pub mean: f64,
    /// The number after ±, whose convention the source may not name.
    pub std: Option<f64>,
}

/// Scores by task and method: the mean and, if printed, the deviation.
type Scores = BTreeMap<String, BTreeMap<String, Vec<f64>>>;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Tables {
    /// Benchmark of its tasks.
    benchmark: String,
    /// Training seeds per score.
    seeds: usize,
    /// Final evaluations averaged.
    last: usize,
    protocol: String,
    method: Vec<Method>,
    scores: Scores,
    remark: Vec<KnownRemark>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Method {
    name: String,
    source: String,
    tables: Vec<String>,
    /// Our algorithm and variant.
    algorithm: Option<String>,
    variant: Option<String>,
}

/// A remark on the scores of some methods.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct KnownRemark {
    methods: Vec<String>,
    /// Patterns of its tasks; empty: all tasks.
    #[serde(default)]
    tasks: Vec<String>,
    /// [`Remark::instead`] by task.
    #[serde(default)]
    instead: BTreeMap<String, f64>,
    reason: String,
    #[serde(default)]
    selected: bool,
}

impl KnownRemark {
    /// The remark, if it applies to a score.
    fn on(&'static self, method: &str, task: &str) -> Option<Remark> {
        let has_task = match (self.tasks.is_empty(), self.instead.is_empty()) {
            (true, true) => true,
            (true, false) => self.instead.contains_key(task),
            (false, _) => self.tasks.iter().any(|pattern| fits(pattern, task)),
        };
        let applies = has_task && self.methods.iter().any(|name| name == method);
        let instead = self.instead.get(task).copied();
        applies.then_some(Remark { reason: &self.reason, instead, selected: self.selected })
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

/// The sources of a task.
fn sources(task: &str) -> impl Iterator<Item = &'static Tables> {
    SOURCES.iter().filter(move |tables| tables.scores.contains_key(task))
}

/// The published scores of a task, the paper's own method first.
pub fn scores(task: &str) -> Vec<Published> {
    let published = |source: &'static Tables| {
        source.method.iter().filter_map(move |method| {
            let name = &method.name;
            let figures = source.scores[task].get(name)?;
            let (mean, std) = (*figures.first()?, figures.get(1).copied());
            let remarks = source.remark.iter().filter_map(|remark| remark.on(name, task));
            Some(Published {
                method: name,
                score: Printed { mean, std },
                source: &method.source,
                tables: &method.tables,
                protocol: &source.protocol,
                remarks: remarks.collect(),
            })
        })
    };
    sources(task).flat_map(published).collect()
}

/// Training seeds per published score of the task; 1 if nothing is published.
pub fn seeds(task: &str) -> usize {
    sources(task).next().map_or(1, |tables| tables.seeds)
}

/// Number of final evaluations averaged for a score. If nothing is published, it is that of the
/// first source for the task's benchmark, else the QUAD paper's.
pub fn final_evaluations(task: &str) -> usize {
    let benchmark = tasks::named(task).ok().and_then(|task| task.benchmark);
    let name = benchmark.map(|benchmark| &benchmark.name);
    let similar = SOURCES.iter().find(|tables| Some(&tables.benchmark) == name);
    sources(task).next().or(similar).unwrap_or(&SOURCES[0]).last
}

/// The tables for runs of an algorithm: the task's tables that contain the algorithm, else the task's
/// first table.
pub fn tables(task: &str, algorithm: &str) -> Vec<&'static str> {
    let figures = scores(task);
    // A table has the task if one of its scores is in no other table.
    let has_task = |table: &&str| figures.iter().any(|figure| figure.tables == [*table]);
    let mut tables = Vec::from_iter(all_tables().into_iter().filter(has_task));
    let has_algorithm = |table: &&str| {
        let own = |method: &&Method| method.algorithm.as_deref() == Some(algorithm);
        all_methods().filter(own).flat_map(|method| &method.tables).any(|name| name == table)
    };
    match tables.iter().any(has_algorithm) {
        true => tables.retain(has_algorithm),
        false => tables.truncate(1),
    }
    tables
}

/// All tables, in their order.
pub fn all_tables() -> Vec<&'static str> {
    let tables = all_methods().flat_map(|method| &method.tables);
    once_each(tables.map(String::as_str))
}

/// The sources' names of a variant of an algorithm: one for each of its rows.
pub fn methods(algorithm: &str, variant: &str) -> Vec<&'static str> {
    let rows = all_methods().filter(|method| {
        method.algorithm.as_deref() == Some(algorithm)
            && method.variant.as_deref().is_none_or(|name| name == variant)
    });
    once_each(rows.map(|method| &*method.name))
}

fn all_methods() -> impl Iterator<Item = &'static Method> {
    SOURCES.iter().flat_map(|tables| &tables.method)
}

/// Removes later duplicates of names.
pub fn once_each<'a>(names: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut seen = BTreeSet::new();
    names.filter(|name| seen.insert(*name)).collect()
}

#[cfg(test)]
mod tests;
