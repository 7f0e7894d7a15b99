//! Chooses the snapshot of a run for a film.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use quad_runtime::Hint;
use serde::Deserialize;

const RUN: &str =
    "name a file like RUN/snapshots/step_000020000.safetensors, or the folder RUN that `learner train` made";

/// The fields of a line of `scores.jsonl` that this module needs.
#[derive(Deserialize)]
struct ScoreLine {
    step: u64,
    score: f64,
}

/// The snapshot that `path` names: the file itself or, in a run's folder, the snapshot of `step`; without a step the best one.
///
/// # Errors
/// There is no such snapshot.
pub fn snapshot(path: &Path, step: Option<u64>) -> anyhow::Result<PathBuf> {
    if !path.is_dir() {
        return match step {
            None => Ok(path.to_owned()),
            Some(_) => {
                Err(anyhow!("{} is not the folder of a run", path.display())).hint("--step is for a run's folder")
            }
        };
    }
    let snapshots = snapshots(path)?;
    let step = match step {
        Some(step) => step,
        None => {
            let scores = fs::read_to_string(path.join("scores.jsonl")).unwrap_or_default();
            let newest = snapshots.keys().next_back().copied();
            let best = best(&scores, |step| snapshots.contains_key(&step)).or(newest);
            best.with_context(|| format!("{} has no snapshot", path.display())).hint(RUN)?
        }
    };
    let found = snapshots.get(&step).cloned();
    let steps: Vec<&u64> = snapshots.keys().collect();
    found
        .with_context(|| format!("{} has no snapshot of step {step}", path.display()))
        .hint(format!("it has {steps:?}"))
}

/// The snapshots of a run by their steps.
fn snapshots(run: &Path) -> anyhow::Result<BTreeMap<u64, PathBuf>> {
    let folder = run.join("snapshots");
    let entries = fs::read_dir(&folder).with_context(|| format!("cannot read {}", folder.display())).hint(RUN)?;
    let paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
    let step =
        |path: &Path| path.file_name()?.to_str()?.strip_prefix("step_")?.strip_suffix(".safetensors")?.parse().ok();
    Ok(paths.filter_map(|path| Some((step(&path)?, path))).collect())
}

/// The step with the highest mean score among the steps in `there` that have the most episodes; of equal ones the last.
fn best(scores: &str, there: impl Fn(u64) -> bool) -> Option<u64> {
    let mut evaluations: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
    // A learner at work may not have finished the last line.
    for ScoreLine { step, score } in scores.lines().filter_map(|line| serde_json::from_str(line).ok()) {
        evaluations.entry(step).or_default().push(score);
    }
    let complete = evaluations.values().map(Vec::len).max()?;
    let mean = |scores: &[f64]| scores.iter().sum::<f64>() / scores.len() as f64;
    let candidates = evaluations.iter().filter(|(step, scores)| scores.len() == complete && there(**step));
    candidates.max_by(|(_, one), (_, other)| mean(one).total_cmp(&mean(other))).map(|(&step, _)| step)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCORES: &str = r#"{"step":10,"seed":1,"return":1.0,"score":5.0}
{"step":10,"seed":2,"return":1.0,"score":7.0}
{"step":20,"seed":3,"return":1.0,"score":9.0}
{"step":20,"seed":4,"return":1.0,"score":1.0}
{"step":30,"seed":5,"return":1.0,"score":99.0}
{"step":30,"seed":6,"re"#;

    #[test]
    fn the_best_complete_evaluation_that_is_kept() {
        assert_eq!(best(SCORES, |_| true), Some(10), "of step 30 an episode is missing");
        assert_eq!(best(SCORES, |step| step > 10), Some(20));
        assert_eq!(best(SCORES, |step| step > 20), None);
        assert_eq!(best("", |_| true), None);
    }

    #[test]
    fn a_folder_gives_its_best_snapshot_or_the_newest_or_the_one_of_a_step() {
        let run = tempfile::tempdir().unwrap();
        fs::create_dir(run.path().join("snapshots")).unwrap();
        let file = |step: u64| run.path().join(format!("snapshots/step_{step:09}.safetensors"));
        assert!(snapshot(run.path(), None).unwrap_err().to_string().contains("has no snapshot"));
        for step in [10, 20, 30] {
            fs::write(file(step), "").unwrap();
        }
        assert_eq!(snapshot(run.path(), None).unwrap(), file(30));
        fs::write(run.path().join("scores.jsonl"), SCORES).unwrap();
        assert_eq!(snapshot(run.path(), None).unwrap(), file(10));
        assert_eq!(snapshot(run.path(), Some(20)).unwrap(), file(20));
        assert!(snapshot(run.path(), Some(25)).is_err());
        assert_eq!(snapshot(&file(20), None).unwrap(), file(20));
        assert!(snapshot(&file(20), Some(20)).is_err());
    }
}
