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
        findings.push(match environment {
            Some(environment) => format!(
                "no array `timeouts`: an episode is taken to end after the {} steps of {}",
                environment.max_episode_steps, environment.name
            ),
            None => "no array `timeouts`: only a terminal is taken to end an episode".to_owned(),
        });
    }
    let of_ends = warnings::of_ends(recording);
    if of_ends.is_empty() {
        let strays = checks::strays(recording).filter(|(_, refused)| !refused);
        findings.extend(strays.map(|(problem, _)| format!("{problem}; is a timeout missing?")));
        findings.extend(leaps(recording));
    }
    findings.extend(of_ends);
    findings.extend(
        checks::actions_outside(recording)
            .map(|problem| format!("{problem}; `learner train --normalize actions` trains on it")),
    );
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
        let apart =
            from.iter().zip(to).take(2).map(|(from, to)| (to - from).powi(2)).sum::<f32>().sqrt();
        apart > LONGEST_STEP
    };
    let leaps = recording.inside().filter(leap).map(|row| (row, RowProblem::Leap(LONGEST_STEP)));
    let problem = checks::first(recording, "observations", leaps)?;
    Some(format!("{problem}; are the timeouts out of step with the resets?"))
}
