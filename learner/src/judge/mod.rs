//! Judges policies without a simulator: `learner judge`.
//!
//! It runs on its caller's thread and rayon's, owns nothing, and keeps what it finds in the runs'
//! folders, from where reports read it. A policy's value is estimated by fitted Q evaluation
//! ([`quad_algorithms::Fqe`]) on the episodes that its run has learned from, and read off in the
//! first states of those that were held out.
//!
//! In reading order: `subject` finds the policies, `data` has the states in which they are judged,
//! `acting` asks a policy for its actions, `evaluation` estimates a value.

mod acting;
mod data;
mod evaluation;
mod subject;

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Duration;

use quad_algorithms::{FqeConfig, Units};
use quad_run::results::{Conditions, Judgment, Ranking};
use quad_runtime::Hint;
use tracing::{info, warn};

use acting::Actions;
use data::Data;
use evaluation::{Evaluation, estimate};
use subject::Subject;

/// How thoroughly policies are judged.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Effort {
    /// Discount γ.
    pub gamma: f32,
    /// Gradient steps of an evaluation.
    pub steps: u64,
    /// Evaluations of each policy.
    pub seeds: u64,
}

/// Judges the last snapshots of runs, or single snapshots. What an earlier call has found out in
/// this way is not computed again.
///
/// # Errors
/// There is nothing to judge, the policies have not learned from the same data in one environment,
/// or a policy cannot act.
pub(crate) fn judge(paths: &[PathBuf], effort: Effort) -> anyhow::Result<Ranking> {
    let config = FqeConfig::with_discount(effort.gamma)
        .hint("γ is between 0 and 1, 1 left out: --gamma 0.99")?;
    let subjects = subject::find(paths)?;
    let data = Data::of(&subjects)?;
    let Effort { gamma, steps, seeds } = effort;
    let conditions = Conditions {
        dataset: data.sha256.clone(),
        environment: data.environment.clone(),
        episodes: data.episodes.clone(),
        gamma,
        steps,
        seeds,
    };
    let (mut judged, mut left) = (Vec::new(), Vec::new());
    for subject in &subjects {
        let known = Judgment::read_all(&subject.folder)?;
        let is_this =
            |one: &Judgment| one.weights == subject.weights && one.conditions == conditions;
        match known.into_iter().find(is_this) {
            Some(known) => judged.push(known),
            None => left.push(subject),
        }
    }
    if !left.is_empty() {
        let evaluation = Evaluation {
            config,
            units: Units::of(&data.context(0), gamma.into()),
            data: &data,
            effort,
        };
        forecast(&evaluation, &left)?;
        judge_all(&evaluation, &left, &conditions, &mut judged)?;
    }
    let [ranking] = <[Ranking; 1]>::try_from(Ranking::of(judged))
        .map_err(|_| anyhow::anyhow!("nothing is judged"))?;
    Ok(ranking)
}

fn judge_all(
    evaluation: &Evaluation<'_>,
    subjects: &[&Subject],
    conditions: &Conditions,
    judged: &mut Vec<Judgment>,
) -> anyhow::Result<()> {
    let data = evaluation.data;
    let behaviors = evaluation.of_behavior()?;
    let fqes = Vec::from_iter(behaviors.iter().map(|(fqe, _)| fqe));
    let recorded = data.recorded_value(&fqes, evaluation.effort.gamma)?;
    let behavior = estimate(behaviors.iter().map(|(_, trace)| trace), &evaluation.units);
    for (subject, number) in subjects.iter().zip(1..) {
        let actions = Actions::of(&*subject.policy, data)?;
        let traces = evaluation.of_policy(&actions, &fqes)?;
        let judgment = Judgment {
            run: subject.folder.path().to_owned(),
            step: subject.step,
            weights: subject.weights.clone(),
            conditions: conditions.clone(),
            estimate: estimate(&traces, &evaluation.units),
            distance: data.distance(&actions.at_states),
            unseen: subject.held_out == BTreeSet::from_iter(data.episodes.iter().copied()),
            behavior: behavior.clone(),
            recorded,
        };
        let run = subject.folder.path().display();
        info!("{number} of {}: {run} @ {} is judged", subjects.len(), subject.step);
        // A folder that cannot be written to, such as another user's, keeps no judgment from being
        // told.
        judgment
            .keep(&subject.folder)
            .unwrap_or_else(|error| warn!("{error}: the judgment is not kept"));
        judged.push(judgment);
    }
    Ok(())
}

/// Says how long it will take, by the time that a little of it takes.
fn forecast(evaluation: &Evaluation<'_>, subjects: &[&Subject]) -> anyhow::Result<()> {
    let asking = subjects.iter().map(|subject| Actions::time(&*subject.policy, evaluation.data));
    let acting = asking.sum::<anyhow::Result<Duration>>()?;
    let evaluating = evaluation.time()? * (subjects.len() as u32 + 1);
    let minutes = |time: Duration| format!("{:.1}", time.as_secs_f64() / 60.0);
    let (all, acting) = (minutes(acting + evaluating), minutes(acting));
    info!(
        "judging {} policies takes about {all} minutes, {acting} of them to ask the policies for actions",
        subjects.len()
    );
    Ok(())
}
