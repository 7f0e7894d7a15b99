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
#[cfg(test)]
mod tests;

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context;
use indicatif::HumanDuration;
use quad_run::results::{Conditions, Judgment, Ranking};
use tracing::{info, warn};

use actions::Actions;
use data::Data;
use evaluation::{Evaluation, estimate};
use snapshots::Snapshot;

/// Discount γ of the values.
const GAMMA: f32 = 0.99;

/// Judges the last snapshots of runs, or single snapshots, by `seeds` evaluations of `steps`
/// gradient steps each. Judgments that the folders have under the same conditions are not computed
/// again.
///
/// `dataset`: the files of the runs' data, if they are not where they have learned from it.
pub(crate) fn judge(
    paths: &[PathBuf],
    dataset: &[String],
    steps: u64,
    seeds: u64,
) -> anyhow::Result<Ranking> {
    let snapshots = snapshots::find(paths)?;
    let conditions = Conditions {
        dataset: String::new(),
        environment: String::new(),
        episodes: Vec::new(),
        gamma: GAMMA,
        steps,
        seeds,
    };
    let data = Data::read(&snapshots, dataset, conditions)?;
    let (mut judgments, mut remaining) = (Vec::new(), Vec::new());
    for snapshot in &snapshots {
        let mut earlier = Judgment::read_all(&snapshot.folder)?;
        earlier.retain(|judgment| judgment.weights == snapshot.weights);
        match earlier.into_iter().find(|judgment| judgment.conditions == data.conditions) {
            // An older file has no caveats.
            Some(earlier) => {
                judgments.push(Judgment { caveat: snapshot.caveat.clone(), ..earlier });
            }
            None => remaining.push(snapshot),
        }
    }
    if !remaining.is_empty() {
        judge_all(&data, &remaining, &mut judgments)?;
    }
    Ranking::from_judgments(judgments).pop().context("nothing is judged")
}

fn judge_all(
    data: &Data,
    snapshots: &[&Snapshot],
    judgments: &mut Vec<Judgment>,
) -> anyhow::Result<()> {
    let evaluation = Evaluation::new(data)?;
    let (fqes, curves) = evaluation.behavior()?;
    let recorded = data.recorded_value(&fqes)?;
    let behavior = estimate(&curves, &evaluation.units);
    for (snapshot, number) in snapshots.iter().zip(1..) {
        let (begin, folder, step) = (Instant::now(), &snapshot.folder, snapshot.step);
        let actions = Actions::new(&*snapshot.policy, data)?;
        let (_, curves) = evaluation.policy(&actions, &fqes)?;
        let held_out = &snapshot.config.dataset.held_out;
        let judgment = Judgment {
            run: folder.path().to_owned(),
            step,
            weights: snapshot.weights.clone(),
            conditions: data.conditions.clone(),
            estimate: estimate(&curves, &evaluation.units),
            distance: data.distance(&actions.compared),
            unseen: data.conditions.episodes.iter().all(|episode| held_out.contains(episode)),
            caveat: snapshot.caveat.clone(),
            behavior: behavior.clone(),
            recorded,
        };
        let (run, count) = (folder.path().display(), snapshots.len());
        let time = HumanDuration(begin.elapsed());
        info!("{number} of {count}: {run} @ {step} is judged, in {time}");
        // A folder of another user's cannot be written to; its judgment is printed all the same.
        if let Err(error) = judgment.save(folder) {
            warn!("{error}: the judgment is not kept");
        }
        judgments.push(judgment);
    }
    Ok(())
}
