//! `learner export`: a policy's file with its data, score and settings in the header.

use std::collections::BTreeMap;

use anyhow::{Context, anyhow};
use quad_policy::{Header, PolicyError, read_tensors};
use quad_protocol::{Hash, Origin, online_seed};
use quad_run::config::Experiment;
use quad_run::files;
use quad_run::folder::{RunDir, read_experience};
use quad_run::results::RunReport;
use quad_run::results::statistics::mean;
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
    let is_online = report.config.experiment.online_begins().is_some();
    let (step, what) = match args.step {
        At::Step(step) => (Some(step), "of that step"),
        At::Last => (steps.last().copied(), "yet"),
        At::Best if is_online => (best, "with a complete evaluation since online learning began"),
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
    let weights = Hash::new(&file).to_string();
    let mut scored = lines.iter().filter(|line| line.step == step);
    if scored.any(|line| line.weights != weights) {
        warn!(
            "the file has no score: that of step {step} is of other weights (learner verify {run})"
        );
        report.evaluations.retain(|it| it.step != step);
    }
    report.judgments.retain(|it| it.weights == weights);
    let experience = experience(&folder, &report.config.experiment, step)?;
    let about = about(&report, step, args.license.as_deref(), experience);
    let exported = Header { about, ..header }.to_safetensors(&tensors)?;
    files::replace(&args.out, &exported)
        .with_context(|| format!("cannot export to {name}"))
        .hint("--out names a file in a folder that is there and that you may write in")?;
    let (run, bytes) = (&report.run, exported.len());
    print(&format!("{name}: {run} @ {step}, {bytes} bytes"))
}

/// Size and mean return of the online episodes that the policy of a step has learned from; null
/// without any.
fn experience(folder: &RunDir, experiment: &Experiment, step: u64) -> anyhow::Result<Value> {
    let rows = experiment.environment_steps(step).unwrap_or(0);
    let played = read_experience(folder.path())?;
    let by_seed = BTreeMap::from_iter(played.iter().map(|it| (it.score.seed, it)));
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
            "experience": experience,
        },
        "score": score,
        // Of several, the newest.
        "judgment": report.judgments.iter().rfind(|judgment| judgment.step == step),
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use quad_protocol::{Episode, EpisodeScore, Name, encode};

    use super::*;
    use crate::fixtures::config;

    #[test]
    fn a_file_counts_the_experience_that_its_policy_has_learned_from() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = RunDir::at(scratch.path());
        let mut experiment = config("run", 3).experiment;
        experiment.steps = 20;
        let online = json!({ "steps": 9, "updates_per_step": 1, "warmup": 0, "uniform_warmup": false,
            "noise": 0.0, "lag": 2, "snapshot_interval": 1 });
        experiment.online = Some(serde_json::from_value(online).unwrap());
        let (mut log, _) = folder.experience_log().unwrap();
        for (number, episode_return) in [(1, 20.0), (0, 10.0), (2, 90.0)] {
            let (seed, precision) = (online_seed(3, number), Name::new("f32").unwrap());
            let played = Episode::new(20, Hash::new(b""), precision, seed);
            let episode = Episode {
                score: EpisodeScore { episode_return, length: 3, ..played.score },
                observations: vec![0.0; 4],
                actions: vec![0.0; 3],
                rewards: vec![0.0; 3],
                ..played
            };
            log.append([&*encode(&episode).unwrap()]).unwrap();
        }
        for (step, rows, episodes, mean) in [(21, 1, 1, 10.0), (24, 4, 2, 15.0), (29, 9, 3, 40.0)] {
            let expected =
                json!({ "transitions": rows, "episodes": episodes, "mean_return": mean });
            assert_eq!(experience(&folder, &experiment, step).unwrap(), expected);
        }
        assert_eq!(experience(&folder, &experiment, 20).unwrap(), Value::Null);
    }

    #[test]
    fn the_license_option_overrides_the_datasets_license() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = config("run", 0);
        config.experiment.dataset = Some("hopper-medium-v2".to_owned());
        RunDir::create(&folder.path().join("run"), &config).unwrap();
        let report = RunReport::scored(&folder.path().join("run")).unwrap();
        let license = |named| about(&report, 20, named, Value::Null)["data"]["license"].clone();
        assert_eq!(license(Some("mine")), "mine");
        assert!(license(None).as_str().is_some_and(|own| own != "mine"));
    }

    #[test]
    fn a_file_says_what_its_data_is() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = config("run", 0);
        let (data, experiment) = (&mut config.dataset, &mut config.experiment);
        (data.min_return, data.mean_return, data.max_return) = (1.0, 2.0, 3.0);
        (data.transitions, data.episodes, data.held_out) = (90, 9, vec![4]);
        (data.sha256, experiment.dataset) = (Some("ab".to_owned()), Some("my.hdf5".to_owned()));
        RunDir::create(&folder.path().join("run"), &config).unwrap();
        let report = RunReport::scored(&folder.path().join("run")).unwrap();
        let expected = json!({ "name": "my.hdf5", "sha256": "ab", "license": "mine", "transitions": 90,
            "episodes": 9, "held_out": [4], "mean_return": 2.0, "experience": null });
        assert_eq!(about(&report, 20, Some("mine"), Value::Null)["data"], expected);
    }
}
