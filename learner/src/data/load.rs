//! The transitions of a run.

use std::path::Path;

use anyhow::{Context, anyhow};
use quad_dataset::{
    DatasetError, HoldOut, ReadOptions, Split, Transitions, benchmarks, environment,
};
use quad_run::config::Experiment;
use quad_runtime::Hint;
use toml::Value;

/// Reads a file or folder of transitions for an experiment. A run that has begun has `held_out`
/// episodes. Fewer transitions than a batch are an error: a batch never holds one twice while there
/// are others.
pub fn load(
    path: &Path,
    experiment: &Experiment,
    held_out: Option<&[usize]>,
) -> anyhow::Result<Split> {
    let chunk = experiment.agent.get("chunk").and_then(Value::as_integer).unwrap_or(1);
    let options = ReadOptions {
        environment: environment::find(&experiment.environment).ok(),
        task: benchmarks::relabeling(&experiment.environment),
        reward: experiment.reward,
        normalize: experiment.normalize,
        chunk: chunk as usize,
    };
    let hold_out = held_out.map_or(HoldOut::Fraction(experiment.hold_out), HoldOut::Episodes);
    let result = Transitions::read_split(path, &options, hold_out).hint_of(DatasetError::hint);
    let path = path.display();
    let split = result.with_context(|| format!("cannot learn from {path}"))?;
    let (there, batch) = (split.training.len(), experiment.batch_size);
    if there < batch as usize {
        let error = anyhow!("{there} transitions are fewer than a batch of {batch}");
        return Err(error).hint("record more data, or ask for less with --set batch_size=N");
    }
    Ok(split)
}

/// Suspicious properties of the transitions at `path`, a sentence each.
pub fn warnings(path: &Path, transitions: &Transitions) -> impl Iterator<Item = String> {
    transitions.warnings().iter().map(move |warning| format!("{}: {warning}", path.display()))
}
