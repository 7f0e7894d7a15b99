//! Off-policy evaluation: ranks policies without a simulator (`learner judge`).
//!
//! The value of a policy is estimated by fitted Q evaluation ([`quad_algorithms::Fqe`]) on the
//! episodes that its run has trained on, and averaged over the first states of held-out episodes.
//! Judgments are saved in the runs' folders, where reports read them.
//!
//! In reading order: `snapshots` finds the policies, `data` reads the dataset, `actions` runs a
//! policy in all states, `evaluation` estimates a value.

mod actions;
mod data;
mod evaluation;
mod snapshots;

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use indicatif::HumanDuration;
use quad_algorithms::{FqeConfig, Units};
use quad_run::results::{Conditions, Judgment, Ranking};
use tracing::{info, warn};

use actions::Actions;
use data::Data;
pub(crate) use evaluation::Budget;
use evaluation::{Evaluation, estimate};
use snapshots::Snapshot;

/// Judges the last snapshots of runs, or single snapshots. Judgments that the folders have under
/// the same conditions are not computed again.
///
/// `dataset`: the data of the runs, if it is not where they have learned from it.
pub(crate) fn judge(
    paths: &[PathBuf],
    dataset: Option<&str>,
    gamma: f32,
    budget: Budget,
) -> anyhow::Result<Ranking> {
    let config = FqeConfig::with_discount(gamma)?;
    let snapshots = snapshots::find(paths)?;
    let data = Data::read(&snapshots, dataset)?;
    let conditions = Conditions {
        dataset: data.sha256.clone(),
        environment: data.environment.clone(),
        episodes: data.episodes.clone(),
        gamma,
        steps: budget.steps,
        seeds: budget.seeds,
    };
    let (mut judgments, mut remaining) = (Vec::new(), Vec::new());
    for snapshot in &snapshots {
        let mut known = Judgment::read_all(&snapshot.folder)?.into_iter();
        match known.find(|it| it.weights == snapshot.weights && it.conditions == conditions) {
            // An older file has no caveats.
            Some(known) => judgments.push(Judgment { caveat: snapshot.caveat.clone(), ..known }),
            None => remaining.push(snapshot),
        }
    }
    if !remaining.is_empty() {
        let units = Units::new(&data.training, gamma.into());
        let evaluation = Evaluation { config, units, data: &data, budget };
        forecast(&evaluation, &remaining)?;
        judge_all(&evaluation, &remaining, &conditions, &mut judgments)?;
    }
    Ranking::from_judgments(judgments).pop().context("nothing is judged")
}

fn judge_all(
    evaluation: &Evaluation<'_>,
    snapshots: &[&Snapshot],
    conditions: &Conditions,
    judgments: &mut Vec<Judgment>,
) -> anyhow::Result<()> {
    let data = evaluation.data;
    let (fqes, curves): (Vec<_>, Vec<_>) = evaluation.of_behavior()?.into_iter().unzip();
    let recorded = data.recorded_value(&fqes, conditions.gamma)?;
    let behavior = estimate(&curves, &evaluation.units);
    for (snapshot, number) in snapshots.iter().zip(1..) {
        let (folder, step) = (&snapshot.folder, snapshot.step);
        let actions = Actions::of(&*snapshot.policy, data)?;
        let curves = evaluation.of_policy(&actions, &fqes)?;
        let judgment = Judgment {
            run: folder.path().to_owned(),
            step,
            weights: snapshot.weights.clone(),
            conditions: conditions.clone(),
            estimate: estimate(&curves, &evaluation.units),
            distance: data.distance(&actions.compared),
            unseen: data.episodes.iter().all(|episode| snapshot.held_out.contains(episode)),
            caveat: snapshot.caveat.clone(),
            behavior: behavior.clone(),
            recorded,
        };
        let (run, count) = (folder.path().display(), snapshots.len());
        info!("{number} of {count}: {run} @ {step} is judged");
        // A folder of another user's cannot be written to; its judgment is printed all the same.
        if let Err(error) = judgment.save(folder) {
            warn!("{error}: the judgment is not kept");
        }
        judgments.push(judgment);
    }
    Ok(())
}

/// Logs how long it will take, extrapolated from a few states and updates.
fn forecast(evaluation: &Evaluation<'_>, snapshots: &[&Snapshot]) -> anyhow::Result<()> {
    let mut acting = Duration::ZERO;
    for snapshot in snapshots {
        acting += Actions::time(&*snapshot.policy, evaluation.data)?;
    }
    let evaluating = evaluation.time()? * (snapshots.len() as u32 + 1);
    let (all, acting) = (HumanDuration(acting + evaluating), HumanDuration(acting));
    info!("judging takes about {all}, {acting} of it for the policies' actions");
    Ok(())
}
