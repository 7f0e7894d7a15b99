//! Chooses the snapshot of a run for a film.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use quad_run::folder::RunDir;
use quad_run::results::RunReport;
use quad_runtime::Hint;

const RUN: &str =
    "pass a file like RUN/snapshots/step_000020000.safetensors, or the folder of a run";

/// The snapshot that `path` names. In a run's folder it is the snapshot of `step` or, without a
/// step, the one with the best complete evaluation of those that are left, else the newest.
pub fn snapshot(path: &Path, step: Option<u64>) -> anyhow::Result<PathBuf> {
    let name = path.display();
    if !path.is_dir() {
        return match step {
            None if path.exists() => Ok(path.to_owned()),
            None => Err(anyhow!("there is no {name}")).hint(RUN),
            Some(_) => Err(anyhow!("{name} is not the folder of a run"))
                .hint("--step needs the folder of a run"),
        };
    }
    let run = RunDir::at(path);
    let steps = run.snapshots().hint(RUN)?;
    let step = match step {
        Some(step) => step,
        None => {
            let report = RunReport::scored(path).hint(RUN)?;
            let best = report.best_of(|step| steps.contains(&step));
            let step = best.map(|best| best.step).or(steps.last().copied());
            step.with_context(|| format!("{name} has no snapshot")).hint(RUN)?
        }
    };
    let found = steps.contains(&step).then(|| run.snapshot_path(step));
    found
        .with_context(|| format!("{name} has no snapshot of step {step}"))
        .hint(format!("its snapshots have the steps {steps:?}"))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use quad_run::config::{RunConfig, resolve};
    use serde_json::json;

    use super::*;

    /// Makes the folder of a run that is evaluated every 10 steps, in two episodes each.
    fn make_run(folder: &Path) {
        let mut experiment = resolve("hopper-demo", &Default::default()).unwrap();
        (experiment.steps, experiment.eval_interval, experiment.episodes) = (50, 10, 2);
        let config = json!({
            "run": { "name": "r", "incarnation": 1, "task": "hopper-demo", "version": "0.1.0" },
            "dataset": { "path": "d", "transitions": 1, "episodes": 1, "min_return": 0.0, "mean_return": 0.0, "max_return": 0.0 },
            "experiment": experiment,
        });
        let config: RunConfig = serde_json::from_value(config).unwrap();
        RunDir::create(folder, &config).unwrap();
    }

    #[test]
    fn chooses_the_best_snapshot_the_newest_or_the_one_of_a_step() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path();
        make_run(run);
        let file = |step: u64| run.join(format!("snapshots/step_{step:09}.safetensors"));
        let set_scores = |scores: &[(u64, u64, f64)], rest: &str| {
            let line = |&(step, seed, score): &(u64, u64, f64)| {
                let line = json!({ "step": step, "seed": seed, "return": 1.0, "length": 5, "score": score, "weights": "00", "evaluator": "e" });
                format!("{line}\n")
            };
            let lines: String = scores.iter().map(line).collect();
            fs::write(run.join("scores.jsonl"), lines + rest).unwrap();
        };
        let error = snapshot(run, None).unwrap_err().to_string();
        assert!(error.contains("has no snapshot"), "{error}");
        for step in [10, 20, 30] {
            fs::write(file(step), "").unwrap();
        }
        set_scores(&[(10, 1, 99.0)], "");
        // No evaluation is complete.
        assert_eq!(snapshot(run, None).unwrap(), file(30));
        let [ten, twenty] = [[(10, 1, 5.0), (10, 2, 7.0)], [(20, 3, 9.0), (20, 4, 1.0)]];
        let scores = [&ten[..], &twenty, &[(30, 5, 99.0)]].concat();
        set_scores(&scores, "{\"step\":30,\"seed\":6,\"re");
        // That of step 30 is incomplete.
        assert_eq!(snapshot(run, None).unwrap(), file(10));
        assert_eq!(snapshot(run, Some(20)).unwrap(), file(20));
        assert!(snapshot(run, Some(25)).is_err());
        assert_eq!(snapshot(&file(20), None).unwrap(), file(20));
        assert!(snapshot(&file(20), Some(20)).is_err());
        fs::remove_file(file(10)).unwrap();
        assert_eq!(snapshot(run, None).unwrap(), file(20));
    }
}
