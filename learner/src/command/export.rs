//! `learner export`: a policy's file with its data, score and settings in the header; and `learner
//! export-data`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::anyhow;
use quad_dataset::{DatasetError, Metadata, OnlineEpisode, write_experience};
use quad_policy::{Header, PolicyError, read_tensors};
use quad_protocol::{Episode, Hash, Origin, online_seed};
use quad_run::config::Experiment;
use quad_run::counted;
use quad_run::folder::{RunDir, read_experience};
use quad_run::results::RunReport;
use quad_run::results::statistics::mean;
use quad_runtime::{Hint, print};
use serde_json::{Value, json};
use tracing::warn;

use crate::cli::{At, ExportArgs, ExportDataArgs};
use crate::data::Source;

pub fn export(args: &ExportArgs) -> anyhow::Result<()> {
    let (mut report, lines) = RunReport::with_scores(&args.run)?;
    let folder = RunDir::at(&args.run);
    let steps = folder.snapshots()?;
    let best = report.best_of(|step| steps.contains(&step)).map(|best| best.step);
    let is_online = report.config.experiment.online_begins().is_some();
    let (step, what) = match args.step {
        At::Step(step) => (Some(step), "of that step"),
        At::Last => (steps.last().copied(), "yet"),
        At::Best if is_online => (best, "with a complete evaluation since online learning began"),
        At::Best => (best, "with a complete evaluation"),
    };
    let (run, name) = (args.run.display(), args.out.display());
    let Some(step) = step.filter(|step| steps.contains(step)) else {
        let named = Vec::from_iter(steps.iter().map(u64::to_string)).join(", ");
        let hint = match steps.is_empty() {
            true => "the learner keeps one at each evaluation, and at the end".to_owned(),
            false => format!("its snapshots are of the steps {named}; name one: --step N"),
        };
        return Err(anyhow!("{run} has no snapshot {what}")).hint(hint);
    };
    let file = folder.read_snapshot(step)?;
    let read = || Ok((Header::<Origin>::read(&file)?, read_tensors(&file)?));
    let path = folder.snapshot_path(step);
    let (header, tensors) = read()
        .map_err(|error: PolicyError| anyhow!("{} is not a policy: {error}", path.display()))?;
    let weights = Hash::new(&file).to_string();
    let mut scored = lines.iter().filter(|line| line.step == step);
    if scored.any(|line| line.weights != weights) {
        warn!(
            "the file has no score: that of step {step} is of other weights (learner verify {run})"
        );
        report.evaluations.retain(|evaluation| evaluation.step != step);
    }
    report.judgments.retain(|judgment| judgment.weights == weights);
    let experience = experience(&folder, &report.config.experiment, step)?;
    let about = about(&report, step, args.license.as_deref(), experience);
    let exported = Header { about, ..header }.to_safetensors(&tensors)?;
    RunDir::write_named(&args.out, &exported)?;
    let (run, bytes) = (&report.run, exported.len());
    print(&format!("{name}: {run} @ {step}, {bytes} bytes"))
}

/// Size and mean return of the online episodes that the policy of a step has learned from; null
/// without any.
fn experience(folder: &RunDir, experiment: &Experiment, step: u64) -> anyhow::Result<Value> {
    let rows = experiment.environment_steps(step).unwrap_or(0);
    let played = read_experience(folder.path())?;
    let by_seed = BTreeMap::from_iter(played.iter().map(|episode| (episode.score.seed, episode)));
    // Training takes them by their number.
    let in_order = (0..).map_while(|number| by_seed.get(&online_seed(experiment.seed, number)));
    let (mut returns, mut before) = (Vec::new(), 0);
    for episode in in_order {
        if before >= rows {
            break;
        }
        returns.push(episode.score.episode_return);
        before += episode.rewards.len() as u64;
    }
    let experience =
        json!({ "transitions": rows, "episodes": returns.len(), "mean_return": mean(&returns) });
    Ok(if rows > 0 { experience } else { Value::Null })
}

fn about(report: &RunReport, step: u64, license: Option<&str>, experience: Value) -> Value {
    let (data, experiment) = (&report.config.dataset, &report.config.experiment);
    let entry = |name: &String| Some(&*Source::parse(name).ok()?.entry()?.license);
    let licenses: Option<BTreeSet<&str>> = experiment.dataset.iter().map(entry).collect();
    let licenses = licenses.map(|licenses| Vec::from_iter(licenses).join(", "));
    let licenses = licenses.filter(|licenses| !licenses.is_empty());
    let license = license.or(licenses.as_deref());
    let has_data = !data.files.is_empty();
    if license.is_none() && has_data {
        warn!("the file does not say which license the data has; --license says it");
    }
    let score = report.evaluations.iter().find(|evaluation| evaluation.step == step);
    if let Some(part) = score.filter(|score| !score.complete) {
        warn!(
            "the score is of {} of {} episodes, which the file says, too",
            part.episodes, experiment.episodes
        );
    }
    json!({
        "run": report.run,
        "task": report.task,
        "algorithm": report.algorithm,
        "steps": report.steps,
        "seed": report.seed,
        "data": {
            "name": has_data.then(|| experiment.dataset.join(", ")),
            "sha256": data.sha256().filter(|_| has_data),
            "license": license,
            "transitions": data.transitions,
            "episodes": data.episodes,
            "held_out": data.held_out,
            "mean_return": data.mean_return,
            "experience": experience,
        },
        "score": score,
        // Of several, the newest.
        "judgment": report.judgments.iter().rfind(|judgment| judgment.step == step),
    })
}

/// `learner export-data`: the experience of a run as a dataset.
pub fn export_data(args: &ExportDataArgs) -> anyhow::Result<()> {
    print(&write_first_rows(&args.run, &args.out, u64::MAX)?)
}

/// Writes the experience of a run, up to the episode that completes this number of rows. Returns
/// what was written, in words.
pub(super) fn write_first_rows(run: &Path, out: &Path, most: u64) -> anyhow::Result<String> {
    RunDir::refuse_own_file(out)?;
    let (folder, config) = RunDir::open(run)?;
    let (mut played, mut before) = (read_experience(folder.path())?, 0);
    played.retain(|episode| {
        let is_among = before < most;
        before += episode.rewards.len() as u64;
        is_among
    });
    let Some(last) = played.last() else {
        return Err(anyhow!("{} has no experience", run.display())).hint(
            "`learner train --online-steps N` lets evaluators play; the learner keeps their episodes",
        );
    };
    let episodes = Vec::from_iter(played.iter().map(|episode| {
        let Episode { observations, actions, rewards, terminated, interventions, .. } = episode;
        let rows = OnlineEpisode { observations, actions, rewards, terminated: *terminated };
        (rows, interventions.as_slice())
    }));
    let experiment = &config.experiment;
    let metadata = Metadata {
        algorithm: &experiment.algorithm,
        iteration: last.step as i64,
        seed: experiment.seed,
        run: Some(config.run.name.as_str()),
        weights: None,
    };
    let (environment, dims) = (&experiment.environment, last.dims());
    write_experience(out, environment, dims, &metadata, &episodes).hint_of(DatasetError::hint)?;
    let rows: usize = episodes.iter().map(|(rows, _)| rows.rewards.len()).sum();
    let (name, episodes) = (out.display(), counted(episodes.len(), "episode"));
    Ok(format!("{name}: {rows} rows of {episodes} in {environment}"))
}
