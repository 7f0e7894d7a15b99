//! A study: methods over the tasks and seeds that they were run with, and against each other.

use std::collections::BTreeSet;
use std::fmt::Alignment::{Left, Right};

use quad_run::results::statistics::{self, Estimate, RESAMPLES, Runs};
use quad_run::table::{Block, Table};
use serde::Serialize;

use super::seeds::GroupReport;

/// A method over all its tasks with D4RL-normalized scores, or over one task without references.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MethodReport {
    /// Its name, as groups have it.
    pub method: String,
    /// What its numbers are: normalized scores, scores of a user's own, or returns.
    pub measure: &'static str,
    /// Its tasks.
    pub tasks: Vec<String>,
    /// Its seeds, in any of the tasks.
    pub seeds: BTreeSet<u64>,
    /// The interquartile mean.
    pub iqm: Estimate,
    /// The mean of the tasks' means.
    pub mean: Estimate,
    /// The median of the tasks' means.
    pub median: Estimate,
    /// Distance to a score of 100, in units of it; absent for returns.
    pub optimality_gap: Option<Estimate>,
    /// The performance profile; empty for returns.
    pub profile: Vec<Share>,
    /// The fewest and the most seeds of a task.
    #[serde(skip)]
    seeds_of_a_task: [usize; 2],
}

/// A point of a performance profile.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Share {
    /// A score.
    pub threshold: f64,
    /// The share of runs that score more.
    #[serde(flatten)]
    pub share: Estimate,
}

/// A method against the first one, in the tasks that both have.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// The one.
    pub method: String,
    /// The other.
    pub against: String,
    /// What both have learned.
    pub tasks: Vec<String>,
    /// Probability that a run of the one scores more than a run of the other.
    pub probability_of_improvement: Estimate,
    /// Pairs of runs with the same task and seed.
    pub pairs: usize,
    /// The mean of their differences; absent without pairs, as are the p-values.
    pub mean_difference: Option<f64>,
    /// p-value of the sign-flip test.
    pub p: Option<f64>,
    /// `p`, corrected for the number of comparisons by Holm's method.
    pub p_holm: Option<f64>,
}

/// Groups of one method, each of another task.
type Method<'a> = Vec<&'a GroupReport>;

/// Summarizes all groups that have scores: each method, and each but the first against the first.
pub fn study(groups: &[GroupReport]) -> (Vec<MethodReport>, Vec<Comparison>) {
    let mut scopes: Vec<Vec<Method>> = Vec::new();
    // Returns of different tasks have no common unit.
    let is_comparable =
        |a: &GroupReport, b: &GroupReport| a.normalized && b.normalized || a.task == b.task;
    for group in groups.iter().filter(|group| !group.scores.is_empty()) {
        let scope = scopes.iter().position(|scope| is_comparable(scope[0][0], group));
        let scope = scope.unwrap_or_else(|| {
            scopes.push(Vec::new());
            scopes.len() - 1
        });
        match scopes[scope].iter_mut().find(|method| method[0].method == group.method) {
            Some(method) => method.push(group),
            None => scopes[scope].push(vec![group]),
        }
    }
    let methods = scopes.iter().flatten().map(|method| of_method(method)).collect();
    let against_first = |scope: &Vec<Method>| {
        scope[1..].iter().filter_map(|method| compare(method, &scope[0])).collect::<Vec<_>>()
    };
    let mut comparisons: Vec<Comparison> = scopes.iter().flat_map(against_first).collect();
    let p_values: Vec<f64> = comparisons.iter().filter_map(|comparison| comparison.p).collect();
    let tested = comparisons.iter_mut().filter(|comparison| comparison.p.is_some());
    tested.zip(statistics::holm(&p_values)).for_each(|(comparison, p)| comparison.p_holm = Some(p));
    (methods, comparisons)
}

fn of_method(method: &Method) -> MethodReport {
    let first = method[0];
    let runs: Runs = method.iter().map(|group| group.scores.clone()).collect();
    let thresholds: Vec<f64> =
        if first.normalized { (0..=120).step_by(2).map(f64::from).collect() } else { Vec::new() };
    let statistics = |drawn: &[Runs]| {
        use statistics::{
            interquartile_mean, mean_of_means, median_of_means, optimality_gap, share_above,
        };
        let aggregates = [interquartile_mean, mean_of_means, median_of_means, optimality_gap]
            .map(|of| of(&drawn[0]));
        aggregates
            .into_iter()
            .chain(thresholds.iter().map(|threshold| share_above(&drawn[0], *threshold)))
            .collect()
    };
    let estimates = statistics::estimates(&[&runs], statistics);
    let shares = thresholds.iter().zip(&estimates[4..]);
    let seeds = || runs.iter().map(Vec::len);
    MethodReport {
        method: first.method.clone(),
        measure: first.measure(),
        tasks: method.iter().map(|group| group.task.clone()).collect(),
        seeds: method.iter().flat_map(|group| &group.seeds).copied().collect(),
        iqm: estimates[0],
        mean: estimates[1],
        median: estimates[2],
        optimality_gap: first.normalized.then_some(estimates[3]),
        profile: shares
            .map(|(threshold, share)| Share { threshold: *threshold, share: *share })
            .collect(),
        seeds_of_a_task: [seeds().min(), seeds().max()].map(Option::unwrap_or_default),
    }
}

/// Nothing if they have no task in common.
fn compare(method: &Method, against: &Method) -> Option<Comparison> {
    let of_task = |task: &str| against.iter().copied().find(|other| other.task == task);
    let common: Vec<_> =
        method.iter().filter_map(|one| Some((*one, of_task(&one.task)?))).collect();
    let first = common.first()?;
    let [x, y]: [Runs; 2] = [
        common.iter().map(|(one, _)| one.scores.clone()).collect(),
        common.iter().map(|(_, other)| other.scores.clone()).collect(),
    ];
    let improvement =
        |drawn: &[Runs]| vec![statistics::probability_of_improvement(&drawn[0], &drawn[1])];
    let differences = common.iter().flat_map(|(one, other)| {
        let of_seed =
            |seed: &u64| other.by_seed().find(|(known, _)| *known == seed).map(|(_, score)| *score);
        one.by_seed().filter_map(move |(seed, score)| Some(score - of_seed(seed)?))
    });
    let differences: Vec<f64> = differences.collect();
    let has_pairs = !differences.is_empty();
    Some(Comparison {
        method: first.0.method.clone(),
        against: first.1.method.clone(),
        tasks: common.iter().map(|(one, _)| one.task.clone()).collect(),
        probability_of_improvement: statistics::estimates(&[&x, &y], improvement)[0],
        pairs: differences.len(),
        mean_difference: has_pairs.then(|| statistics::mean(&differences)),
        p: has_pairs.then(|| statistics::sign_flip_test(&differences)),
        p_holm: None,
    })
}

/// Both as tables, with what a reader has to know of them.
pub fn tables(methods: &[MethodReport], comparisons: &[Comparison]) -> Vec<Block> {
    let names = ["seeds", "IQM", "mean", "median", "optimality gap"].map(|name| (name, Right));
    let mut table = Table::new(
        &[("method", Left), ("tasks", Left)].into_iter().chain(names).collect::<Vec<_>>(),
    );
    let mut notes = format!(
        "Over tasks and seeds, in brackets the 95 % interval of the bootstrap: {RESAMPLES} times, seeds are drawn in each task \
         (Agarwal et al. 2021). The optimality gap is that of scores over 100. Only complete runs count.\n"
    );
    for m in methods {
        let tasks = match m.optimality_gap {
            Some(_) => m.tasks.len().to_string(),
            None => format!("{} ({}s)", m.tasks[0], m.measure),
        };
        let [fewest, most] = m.seeds_of_a_task;
        let seeds = if fewest == most { most.to_string() } else { format!("{fewest} to {most}") };
        let [iqm, mean, median] = [m.iqm, m.mean, m.median].map(|estimate| estimate.text(2));
        let gap = m.optimality_gap.map_or_else(|| "-".to_owned(), |gap| gap.text(3));
        table.push([m.method.clone(), tasks, seeds, iqm, mean, median, gap]);
        if fewest < 2 {
            notes += &format!(
                "No interval for {}: of a single seed in a task, the spread is not known.\n",
                m.method
            );
        }
    }
    let mut parts = vec![Block::Text(notes), Block::Table(table)];
    if !comparisons.is_empty() {
        let names = ["pairs", "mean difference", "p", "p (Holm)", "probability of improvement"]
            .map(|name| (name, Right));
        let names =
            [("method", Left), ("against", Left), ("tasks", Right)].into_iter().chain(names);
        let mut table = Table::new(&Vec::from_iter(names));
        for c in comparisons {
            let number = |value: Option<f64>, digits: usize| {
                value.map_or_else(|| "-".to_owned(), |v| format!("{v:.digits$}"))
            };
            let [tasks, pairs] = [c.tasks.len(), c.pairs].map(|count| count.to_string());
            let [difference, p, p_holm] =
                [number(c.mean_difference, 2), number(c.p, 4), number(c.p_holm, 4)];
            let improvement = c.probability_of_improvement.text(2);
            table.push([
                c.method.clone(),
                c.against.clone(),
                tasks,
                pairs,
                difference,
                p,
                p_holm,
                improvement,
            ]);
        }
        parts.push(Block::Text(format!(
            "Against the method named first, in the tasks that both have: the mean difference of runs with the same task and seed, \
             its p-value by sign flips (Fisher 1935), corrected for {} comparisons (Holm 1979), and the probability that a run \
             scores more than one of the other.\n",
            comparisons.len()
        )));
        parts.push(Block::Table(table));
    }
    parts
}
