//! Warnings about data that training accepts but that is probably wrong. A warning names the array,
//! the fraction or number of rows, a likely cause, and a remedy.

mod copied;
mod ends;
mod late;
mod resets;
mod rest;
mod rewards;
mod sizes;

use crate::normalize::Normalize;
use crate::recording::Recording;
use crate::tables::reward::RewardRule;

/// Number of evenly spaced rows that are sampled.
const ENOUGH: usize = 20_000;

pub(crate) fn warnings(
    recording: &Recording,
    normalize: Normalize,
    rule: RewardRule,
) -> Vec<String> {
    let mut warnings = of_ends(recording);
    warnings.extend(of_numbers(recording, normalize, rule));
    warnings
}

pub(crate) fn of_ends(recording: &Recording) -> Vec<String> {
    match ends::meaning(recording) {
        Some(warning) => vec![warning],
        None => resets::out_of_step(recording),
    }
}

pub(crate) fn of_numbers(
    recording: &Recording,
    normalize: Normalize,
    rule: RewardRule,
) -> Vec<String> {
    let copied = copied::actions(recording);
    let rest = rest::observations(recording);
    let late =
        if copied.is_some() || rest.is_some() { None } else { late::observations(recording) };
    let mut warnings = Vec::from_iter(rewards::alike(recording));
    if warnings.is_empty() {
        warnings.extend(rewards::after_goal(recording));
        // A task's rule or normalization sets the size.
        let is_own = rule == RewardRule::AsIs && !normalize.rewards;
        warnings.extend(if is_own { rewards::size(recording) } else { None });
    }
    warnings.extend(copied.into_iter().chain(rest).chain(late));
    warnings.extend(sizes::columns(recording, normalize));
    warnings
}

pub(crate) fn named(columns: &[usize], names: &[String]) -> String {
    let one = |column: &usize| match names.get(*column) {
        Some(name) => format!("{column} ({name})"),
        None => column.to_string(),
    };
    let word = if columns.len() == 1 { "column" } else { "columns" };
    format!("{word} {}", Vec::from_iter(columns.iter().map(one)).join(", "))
}

fn short(x: f64) -> String {
    if x == 0.0 || x.abs() >= 0.1 { format!("{x:.1}") } else { format!("{x:.1e}") }
}

fn percent(part: usize, whole: usize) -> String {
    format!("{:.3}", 100.0 * part as f64 / whole as f64)
        .trim_end_matches('0')
        .trim_end_matches('.')
        .to_owned()
        + " %"
}

impl Recording {
    /// Rows with a following step, at most [`ENOUGH`].
    fn some_that_go_on(&self) -> Vec<usize> {
        let apart = self.rows().div_ceil(ENOUGH).max(1);
        (0..self.rows()).step_by(apart).filter(|&row| self.goes_on(row)).collect()
    }
}
