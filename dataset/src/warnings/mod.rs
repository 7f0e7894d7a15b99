//! Warnings about data that training accepts but that is probably wrong. A warning names the array,
//! the fraction or number of rows, a likely cause, and a remedy.

mod ends;
mod late;
mod lengths;
mod resets;
mod rewards;
mod rows;
mod sizes;

use crate::checks;
use crate::formats::ReadOptions;
use crate::recording::Recording;
use crate::tables::reward::RewardRule;

/// Number of evenly spaced rows that are sampled.
const ENOUGH: usize = 20_000;

/// All that is doubtful in the rows of a file, for whatever program reads it.
pub(crate) fn file_warnings(recording: &Recording, run: &ReadOptions) -> Vec<String> {
    let outside = checks::actions_outside(recording).filter(|_| !run.normalize.actions);
    let outside = outside.map(|problem| format!("{problem}; {}", problem.hint()));
    let mut warnings = recording.doubts.clone();
    warnings.extend(end_warnings(recording));
    warnings.extend(outside);
    warnings.extend(rows::unwritten(recording));
    let copied = rows::copied_actions(recording);
    let resting = rows::resting_observations(recording);
    let late = match (&copied, &resting) {
        (None, None) => late::observations(recording),
        _ => None,
    };
    warnings.extend(copied.into_iter().chain(resting).chain(late));
    warnings
}

fn end_warnings(recording: &Recording) -> Vec<String> {
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

/// All that is doubtful in the numbers of a dataset, of which a file may have a part: its failures, or
/// a column that does not move there.
pub(crate) fn number_warnings(recording: &Recording, run: &ReadOptions) -> Vec<String> {
    let (normalize, rule) = (run.normalize, run.reward);
    let mut warnings = Vec::from_iter(lengths::chunks(recording, run.chunk));
    let alike = rewards::alike(recording);
    if alike.is_none() {
        warnings.extend(rewards::after_goal(recording));
        // A task's rule or normalization sets the size.
        if rule == RewardRule::AsIs && !normalize.rewards {
            warnings.extend(rewards::size(recording));
        }
    }
    warnings.extend(alike);
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
        let leads_on = |row: &usize| self.goes_on(*row) && !self.jumps(*row);
        rows.filter(leads_on).collect()
    }
}
