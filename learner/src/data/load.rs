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
    let hold_out = HoldOut::Fraction { fraction: experiment.hold_out, seed: experiment.seed };
    let result = Transitions::read_split(path, &options, hold_out);
    let hint = result.as_ref().err().map(DatasetError::hint).unwrap_or_default();
    let split =
        result.with_context(|| format!("cannot learn from {}", path.display())).hint(hint)?;
    for warning in split.training.warnings() {
        tracing::warn!("{}: {warning}", path.display());
    }
    let (there, batch) = (split.training.len(), experiment.batch_size);
    if there < batch as usize {
        return Err(anyhow!("{there} transitions are fewer than a batch of {batch}"))
            .hint("record more data, or ask for less with --set batch_size=N");
    }
    Ok(split)
}
