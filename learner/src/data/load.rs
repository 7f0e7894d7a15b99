//! The transitions of a run.

use std::path::Path;

use anyhow::{Context, anyhow};
use quad_dataset::{
    DatasetError, HoldOut, ReadOptions, Split, Transitions, benchmarks, environment,
};
use quad_run::config::Experiment;
use quad_runtime::Hint;

/// Reads a file or folder of transitions for an experiment. Fewer transitions than a batch are an
/// error: a batch never holds one twice while there are others.
pub fn load(path: &Path, experiment: &Experiment) -> anyhow::Result<Split> {
    let options = ReadOptions {
        environment: environment::find(&experiment.environment).ok(),
        task: benchmarks::relabeling(&experiment.environment),
        reward: experiment.reward,
        normalize: experiment.normalize,
    };
    let (fraction, seed) = (experiment.hold_out, experiment.seed);
    let hold_out = HoldOut::Fraction { fraction, seed };
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
