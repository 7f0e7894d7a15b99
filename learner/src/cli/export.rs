//! The arguments of `learner export`.

use std::path::PathBuf;
use std::str::FromStr;

use clap::Args;

pub(super) const EXAMPLES: &str = "\
Examples:
  # The snapshot with the best evaluation, to be carried to a robot.
  learner export runs/mine --step best --out policy.safetensors

  # What the file says of itself.
  python -c \"import quad_rl; print(quad_rl.Policy.load('policy.safetensors').about)\"

`evaluator score`, `quad_rl.Policy.load` and `quad_rl.export_onnx` read the file (docs/deploying.md).";

/// Arguments of `learner export`.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Folder of the run
    #[arg(value_name = "RUN")]
    pub run: PathBuf,
    /// Which snapshot: that of a gradient step, `best`, the one with the best evaluation, or `last`
    #[arg(long, value_name = "N|best|last", default_value = "last")]
    pub step: At,
    /// The file to write
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// License of the data [default: that of a dataset of `learner datasets list`]
    #[arg(long, value_name = "TEXT")]
    pub license: Option<String>,
}

/// Which snapshot of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum At {
    /// The one after a gradient step.
    Step(u64),
    /// The one with the best evaluation.
    Best,
    /// The last one.
    Last,
}

impl FromStr for At {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "best" => Ok(Self::Best),
            "last" => Ok(Self::Last),
            number => number
                .parse()
                .map(Self::Step)
                .map_err(|_| format!("{number} is no step, and neither best nor last")),
        }
    }
}
