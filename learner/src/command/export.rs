//! `learner export`: a policy's file with its data, score and settings in the header.

use anyhow::{Context, anyhow};
use quad_policy::{Header, PolicyError, read_tensors};
use quad_protocol::{Hash, Origin};
use quad_run::files;
use quad_run::folder::RunDir;
use quad_run::results::RunReport;
use quad_runtime::{Hint, print};
use serde_json::{Value, json};
use tracing::warn;

use crate::cli::{At, ExportArgs};
use crate::data::Source;

pub fn export(args: &ExportArgs) -> anyhow::Result<()> {
    let (mut report, lines) = RunReport::with_scores(&args.run)?;
    let folder = RunDir::at(&args.run);
    let steps = folder.snapshots()?;
    let best = report.best_of(|step| steps.contains(&step)).map(|best| best.step);
    let (step, what) = match args.step {
        At::Step(step) => (Some(step), "of that step"),
        At::Last => (steps.last().copied(), "yet"),
        At::Best => (best, "with a complete evaluation"),
    };
    let (run, name) = (args.run.display(), args.out.display());
    RunDir::refuse_own_file(&args.out)?;
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
    let weights = Hash::of(&file).to_string();
    let mut scored = lines.iter().filter(|line| line.step == step);
    if scored.any(|line| line.weights != weights) {
        warn!(
            "the file has no score: that of step {step} is of other weights (learner verify {run})"
        );
        report.evaluations.retain(|it| it.step != step);
    }
    report.judgments.retain(|it| it.weights == weights);
    let about = about(&report, step, args.license.as_deref());
    let exported = Header { about, ..header }.to_safetensors(&tensors)?;
    files::replace(&args.out, &exported)
        .with_context(|| format!("cannot export to {name}"))
        .hint("--out names a file in a folder that is there and that you may write in")?;
    let (run, bytes) = (&report.run, exported.len());
    print(&format!("{name}: {run} @ {step}, {bytes} bytes"))
}

fn about(report: &RunReport, step: u64, license: Option<&str>) -> Value {
    let (data, experiment) = (&report.config.dataset, &report.config.experiment);
    let name = experiment.dataset.clone().unwrap_or_default();
    let entry = Source::parse(&name).ok().and_then(|source| source.entry());
    let license = license.or(entry.map(|entry| &*entry.license));
    if license.is_none() {
        warn!("the file does not say which license the data has; --license says it");
    }
    let score = report.evaluations.iter().find(|it| it.step == step);
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
            "name": name,
            "sha256": data.sha256,
            "license": license,
            "transitions": data.transitions,
            "episodes": data.episodes,
            "held_out": data.held_out,
            "mean_return": data.mean_return,
        },
        "score": score,
        "judgment": report.judgments.iter().find(|judgment| judgment.step == step),
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::fixtures::config;

    #[test]
    fn the_license_option_overrides_the_datasets_license() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = config("run", 0);
        config.experiment.dataset = Some("hopper-medium-v2".to_owned());
        RunDir::create(&folder.path().join("run"), &config).unwrap();
        let report = RunReport::scored(&folder.path().join("run")).unwrap();
        let license = |named| about(&report, 20, named)["data"]["license"].clone();
        assert_eq!(license(Some("mine")), "mine");
        assert!(license(None).as_str().is_some_and(|own| own != "mine"));
    }
}
