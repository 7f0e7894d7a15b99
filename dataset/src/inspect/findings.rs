//! Problems of a dataset that training accepts.

use crate::error::RowProblem;
use crate::formats::Source;
use crate::normalize::Normalize;
use crate::recording::Recording;
use crate::tables::environment::EnvironmentSpec;
use crate::tables::reward::RewardRule;
use crate::{checks, warnings};

/// Largest displacement of a maze robot in a step of 0.1 s, meters.
const LONGEST_STEP: f32 = 1.0;

pub(super) fn findings(
    source: &Source,
    recording: &Recording,
    environment: Option<&EnvironmentSpec>,
) -> Vec<String> {
    let mut findings = Vec::new();
    if source.lacks_timeouts() {
        let end = match environment {
            Some(spec) => format!("after the {} steps of {}", spec.max_episode_steps, spec.name),
            None => "at a terminal alone".to_owned(),
        };
        findings.push(format!("no array `timeouts`: an episode is taken to end {end}"));
    }
    if source.lacks_masks() {
        findings.push("no array `masks`: no step counts as terminal, as `terminals` are the ends of OGBench's trajectories".to_owned());
    }
    let of_ends = warnings::of_ends(recording);
    if of_ends.is_empty() {
        let strays = checks::strays(recording).filter(|(_, refused)| !refused);
        findings.extend(strays.map(|(problem, _)| format!("{problem}; is a timeout missing?")));
        findings.extend(leaps(recording));
    }
    findings.extend(of_ends);
    let outside = checks::actions_outside(recording);
    let remedy = "`learner train --normalize actions` trains on it";
    findings.extend(outside.map(|problem| format!("{problem}; {remedy}")));
    let rule = environment.map_or(RewardRule::AsIs, |environment| environment.reward);
    findings.extend(warnings::of_numbers(recording, Normalize::default(), rule));
    findings
}

/// Rows whose position (first two dimensions) is too far from the next row's.
fn leaps(recording: &Recording) -> Option<String> {
    if !recording.goal {
        return None;
    }
    let leap = |&row: &usize| {
        let (from, to) = (recording.observation(row), recording.observation(row + 1));
        let apart = from.iter().zip(to).take(2).map(|(from, to)| (to - from).powi(2));
        apart.sum::<f32>().sqrt() > LONGEST_STEP
    };
    let leaps = recording.inside().filter(leap);
    let leaps = leaps.map(|row| (row, RowProblem::Leap(LONGEST_STEP)));
    let problem = checks::first(recording, "observations", leaps)?;
    Some(format!("{problem}; are the timeouts out of step with the resets?"))
}
