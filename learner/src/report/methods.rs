//! Methods over all their tasks and seeds, and in comparison with each other.

use std::collections::BTreeSet;
use std::fmt::Alignment::{Left, Right};

use quad_run::results::statistics::{self, Estimate, RESAMPLES, Runs};
use quad_run::table::{Block, Table};
use serde::Serialize;

use super::groups::GroupReport;

/// A method over all its tasks with D4RL-normalized scores, or over one task with returns.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MethodReport {
    pub method: String,
    pub measure: &'static str,
    pub tasks: Vec<String>,
    /// Seeds of any of the tasks.
    pub seeds: BTreeSet<u64>,
    /// Interquartile mean.
    pub iqm: Estimate,
    /// Mean of the tasks' means.
    pub mean: Estimate,
    /// Median of the tasks' means.
    pub median: Estimate,
    /// Absent for returns.
    pub optimality_gap: Option<Estimate>,
    /// Performance profile; empty for returns.
    pub profile: Vec<ProfilePoint>,
    /// Smallest and largest number of seeds of a task.
    #[serde(skip)]
    seeds_per_task: [usize; 2],
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ProfilePoint {
    pub threshold: f64,
    /// Share of runs whose score is above the threshold.
    #[serde(flatten)]
    pub share: Estimate,
}

/// A method against another, in the tasks that both have.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    pub method: String,
    pub against: String,
    pub tasks: Vec<String>,
    pub probability_of_improvement: Estimate,
    /// Pairs of runs with the same task and seed.
    pub pairs: usize,
    /// Absent without pairs, as are the p-values.
    pub mean_difference: Option<f64>,
    /// p-value of the sign-flip test.
    pub p: Option<f64>,
    /// Corrected for the number of comparisons by Holm's method.
    pub p_holm: Option<f64>,
}

/// Groups of one method, each of another task.
type Method<'a> = Vec<&'a GroupReport>;

/// Aggregates all groups that have scores, and compares each method with the first.
pub fn aggregate(groups: &[GroupReport]) -> (Vec<MethodReport>, Vec<Comparison>) {
    // Returns of different tasks have no common unit.
    let mut comparable: Vec<Vec<Method>> = Vec::new();
    for group in groups.iter().filter(|group| !group.scores.is_empty()) {
        let fits = |methods: &Vec<Method>| {
            let other = methods[0][0];
            other.normalized && group.normalized || other.task == group.task
        };
        let index = comparable.iter().position(fits).unwrap_or(comparable.len());
        if index == comparable.len() {
            comparable.push(Vec::new());
        }
        let methods = &mut comparable[index];
        match methods.iter_mut().find(|method| method[0].method == group.method) {
            Some(method) => method.push(group),
            None => methods.push(vec![group]),
        }
    }
    let reports = comparable.iter().flatten().map(method_report).collect();
    let mut comparisons = Vec::new();
    for methods in &comparable {
        let compared = methods[1..].iter().filter_map(|method| compare(method, &methods[0]));
        comparisons.extend(compared);
    }
    let p_values = Vec::from_iter(comparisons.iter().filter_map(|comparison| comparison.p));
    let tested = comparisons.iter_mut().filter(|comparison| comparison.p.is_some());
    for (comparison, p) in tested.zip(statistics::holm(&p_values)) {
        comparison.p_holm = Some(p);
    }
    (reports, comparisons)
}

fn method_report(method: &Method) -> MethodReport {
    use statistics::{fraction_above, interquartile_mean, mean_of_means};
    use statistics::{median_of_means, optimality_gap};
    let first = method[0];
    let runs: Runs = method.iter().map(|group| group.scores.clone()).collect();
    let count = if first.normalized { 61 } else { 0 };
    let thresholds = Vec::from_iter((0..count).map(|index| f64::from(2 * index)));
    let statistics = |drawn: &[Runs]| {
        let runs = &drawn[0];
        let mut values = vec![interquartile_mean(runs), mean_of_means(runs)];
        values.extend([median_of_means(runs), optimality_gap(runs)]);
        values.extend(thresholds.iter().map(|threshold| fraction_above(runs, *threshold)));
        values
    };
    let estimates = statistics::estimates(&[&runs], statistics);
    let mut profile = Vec::new();
    for (&threshold, &share) in thresholds.iter().zip(&estimates[4..]) {
        profile.push(ProfilePoint { threshold, share });
    }
    let seeds = || runs.iter().map(Vec::len);
    let all_seeds = method.iter().flat_map(|group| &group.seeds);
    MethodReport {
        method: first.method.clone(),
        measure: first.measure(),
        tasks: method.iter().map(|group| group.task.clone()).collect(),
        seeds: all_seeds.copied().collect(),
        iqm: estimates[0],
        mean: estimates[1],
        median: estimates[2],
        optimality_gap: first.normalized.then_some(estimates[3]),
        profile,
        seeds_per_task: [seeds().min(), seeds().max()].map(Option::unwrap_or_default),
    }
}

/// `None` without a common task.
fn compare(method: &Method, against: &Method) -> Option<Comparison> {
    let (mut tasks, mut x, mut y, mut differences) = (vec![], Runs::new(), Runs::new(), vec![]);
    for one in method {
        let other = against.iter().find(|other| other.task == one.task);
        let Some(other) = other else { continue };
        tasks.push(one.task.clone());
        x.push(one.scores.clone());
        y.push(other.scores.clone());
        for (seed, score) in one.by_seed() {
            let pair = other.by_seed().find(|(other, _)| *other == seed);
            differences.extend(pair.map(|(_, other)| score - other));
        }
    }
    if tasks.is_empty() {
        return None;
    }
    let improvement =
        |drawn: &[Runs]| vec![statistics::probability_of_improvement(&drawn[0], &drawn[1])];
    let has_pairs = !differences.is_empty();
    Some(Comparison {
        method: method[0].method.clone(),
        against: against[0].method.clone(),
        tasks,
        probability_of_improvement: statistics::estimates(&[&x, &y], improvement)[0],
        pairs: differences.len(),
        mean_difference: has_pairs.then(|| statistics::mean(&differences)),
        p: has_pairs.then(|| statistics::sign_flip_test(&differences)),
        p_holm: None,
    })
}

impl MethodReport {
    fn tasks_in_words(&self) -> String {
        match self.optimality_gap {
            Some(_) => self.tasks.len().to_string(),
            None => format!("{} ({}s)", self.tasks[0], self.measure),
        }
    }

    fn seeds_in_words(&self) -> String {
        match self.seeds_per_task {
            [fewest, most] if fewest == most => most.to_string(),
            [fewest, most] => format!("{fewest} to {most}"),
        }
    }
}

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.digits$}"))
}

pub fn tables(methods: &[MethodReport], comparisons: &[Comparison]) -> Vec<Block> {
    let mut notes = format!(
        "Over tasks and seeds, in brackets the 95 % interval of the bootstrap: {RESAMPLES} times, seeds are drawn in each task \
         (Agarwal et al. 2021). The optimality gap is that of scores over 100. Only complete runs count.\n"
    );
    for MethodReport { method, .. } in methods.iter().filter(|method| method.seeds_per_task[0] < 2)
    {
        notes += &format!(
            "No interval for {method}: of a single seed in a task, the spread is not known.\n"
        );
    }
    let table = Table::from_rows(
        methods,
        &[
            ("method", Left, |row| row.method.clone()),
            ("tasks", Left, MethodReport::tasks_in_words),
            ("seeds", Right, MethodReport::seeds_in_words),
            ("IQM", Right, |row| row.iqm.text(2)),
            ("mean", Right, |row| row.mean.text(2)),
            ("median", Right, |row| row.median.text(2)),
            ("optimality gap", Right, |row| {
                row.optimality_gap.map_or("-".to_owned(), |gap| gap.text(3))
            }),
        ],
    );
    let mut blocks = vec![Block::Text(notes), Block::Table(table)];
    if comparisons.is_empty() {
        return blocks;
    }
    blocks.push(Block::Text(format!(
        "Against the method named first, in the tasks that both have: the mean difference of runs with the same task and seed, \
         its p-value by sign flips (Fisher 1935), corrected for {} comparisons (Holm 1979), and the probability that a run \
         scores more than one of the other.\n",
        comparisons.len()
    )));
    blocks.push(Block::Table(Table::from_rows(
        comparisons,
        &[
            ("method", Left, |row| row.method.clone()),
            ("against", Left, |row| row.against.clone()),
            ("tasks", Right, |row| row.tasks.len().to_string()),
            ("pairs", Right, |row| row.pairs.to_string()),
            ("mean difference", Right, |row| number(row.mean_difference, 2)),
            ("p", Right, |row| number(row.p, 4)),
            ("p (Holm)", Right, |row| number(row.p_holm, 4)),
            ("probability of improvement", Right, |row| row.probability_of_improvement.text(2)),
        ],
    )));
    blocks
}
