//! Hints for a run whose dataset is not named, or not there.

use quad_dataset::environment;
use quad_run::config::{Experiment, Preset};

/// A hint for a run without a dataset, of a benchmark whose files lack the rewards.
pub(super) fn convert_hint(preset: &Preset) -> Option<String> {
    let (task, benchmark) = (preset.task_name(), preset.task?.benchmark?);
    let (name, converter) = (&benchmark.name, benchmark.converter.as_ref()?);
    Some(format!(
        "its rewards come from {name}'s simulator: with quad_rl and {converter} installed, `quad-convert {converter}:{task} --out \
         FILE` makes a file for --dataset FILE"
    ))
}

/// A hint for any other run whose dataset is not named, or not there.
pub(super) fn record_hint(experiment: &Experiment) -> String {
    let (name, files) = (&experiment.environment, &*experiment.dataset);
    let advice = match files {
        [] => "name a file by --dataset FILE",
        _ => "check the path",
    };
    let can_record = environment::find(name).is_ok_and(|spec| spec.maze.is_none());
    let other = match can_record {
        true => {
            let file = if let [file] = files { file } else { "FILE" };
            format!("`evaluator collect --env {name} --out {file}` records one")
        }
        false => "docs/data.md says what it may be".to_owned(),
    };
    format!("{advice}; {other}")
}
