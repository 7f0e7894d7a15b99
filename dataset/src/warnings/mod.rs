//! Warnings about data that training accepts but that is probably wrong. A warning names the array,
//! the fraction or number of rows, a likely cause, and a remedy.

mod copied;
mod ends;
mod late;
mod lengths;
mod resets;
mod rest;
mod rewards;
mod sizes;
mod unwritten;

use crate::checks;
use crate::read_options::ReadOptions;
use crate::recording::Recording;
use crate::tables::reward::RewardRule;

/// Number of evenly spaced rows that are sampled.
const ENOUGH: usize = 20_000;

/// All that is doubtful in the whole recording, for whatever program reads it.
pub(crate) fn warnings(recording: &Recording, run: &ReadOptions) -> Vec<String> {
    let outside = checks::actions_outside(recording).filter(|_| !run.normalize.actions);
    let outside = outside.map(|problem| format!("{problem}; {}", problem.hint()));
    let doubts = recording.doubts.iter().cloned().chain(of_ends(recording));
    let doubts = doubts.chain(lengths::chunks(recording, run.chunk)).chain(outside);
    doubts.chain(of_numbers(recording, run)).collect()
}

fn of_ends(recording: &Recording) -> Vec<String> {
    if let Some(warning) = ends::meaning(recording).or_else(|| lengths::single_steps(recording)) {
        return vec![warning];
    }
    let mut warnings = resets::out_of_step(recording);
    if warnings.is_empty() {
        warnings.extend(match checks::strays(recording) {
            Some((problem, is_refused)) => {
                (!is_refused).then(|| format!("{problem}; is a timeout missing?"))
            }
            None => resets::missed(recording),
        });
    }
    warnings.extend(lengths::time_limit(recording));
    warnings
}

fn of_numbers(recording: &Recording, run: &ReadOptions) -> Vec<String> {
    let (normalize, rule) = (run.normalize, run.reward);
    let copied = copied::actions(recording);
    let rest = rest::observations(recording);
    let is_other = copied.is_some() || rest.is_some();
    let late = (!is_other).then(|| late::observations(recording)).flatten();
    let mut warnings = Vec::from_iter(rewards::alike(recording));
    if warnings.is_empty() {
        warnings.extend(rewards::after_goal(recording));
        // A task's rule or normalization sets the size.
        if rule == RewardRule::AsIs && !normalize.rewards {
            warnings.extend(rewards::size(recording));
        }
    }
    warnings.extend(unwritten::rows(recording));
    warnings.extend(copied.into_iter().chain(rest).chain(late));
    warnings.extend(sizes::columns(recording, normalize));
    warnings
}

fn short(x: f64) -> String {
    match x == 0.0 || x.abs() >= 0.1 {
        true => format!("{x:.1}"),
        false => format!("{x:.1e}"),
    }
}

fn percent(part: usize, whole: usize) -> String {
    let percent = format!("{:.3}", 100.0 * part as f64 / whole as f64);
    let short = percent.trim_end_matches('0').trim_end_matches('.');
    format!("{short} %")
}

impl Recording {
    /// Rows that lead to the following one, at most [`ENOUGH`].
    fn some_that_go_on(&self) -> Vec<usize> {
        let rows = (0..self.rows()).step_by(self.rows().div_ceil(ENOUGH).max(1));
        rows.filter(|&row| self.goes_on(row) && !self.jumps(row)).collect()
    }
}
