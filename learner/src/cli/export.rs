//! The arguments of `learner export` and `learner export-data`.

use std::path::PathBuf;

use clap::Args;

pub(super) const EXAMPLES: &str = "\
Examples:
  # The snapshot with the best evaluation, to be carried to a robot.
  learner export runs/mine --step best --out policy.safetensors

  # What the file says of itself.
  python -c \"import quad_rl; print(quad_rl.Policy.load('policy.safetensors').about)\"

`evaluator score`, `quad_rl.Policy.load` and `quad_rl.export_onnx` read the file (docs/deploying.md).";

#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    pub run: PathBuf,
    /// The snapshot: that of a gradient step, `best`, the one with the best evaluation, or `last`
    #[arg(long, value_name = "N|best|last", default_value = "last", value_parser = parse_at)]
    pub step: At,
    /// The file to write
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// License of the data [default: that of a dataset of `learner datasets list`]
    #[arg(long, value_name = "TEXT")]
    pub license: Option<String>,
}

#[derive(Debug, Args)]
pub struct ExportDataArgs {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    pub run: PathBuf,
    /// The file to write, in D4RL's layout
    #[arg(long, value_name = "FILE.hdf5")]
    pub out: PathBuf,
}

/// A snapshot of a run: after a gradient step, the one with the best evaluation, or the last.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum At {
    Step(u64),
    Best,
    Last,
}

fn parse_at(text: &str) -> Result<At, String> {
    match text {
        "best" => Ok(At::Best),
        "last" => Ok(At::Last),
        number => number
            .parse()
            .map(At::Step)
            .map_err(|_| format!("{number} is no step, and neither best nor last")),
    }
}
