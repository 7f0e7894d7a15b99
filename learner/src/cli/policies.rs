//! The arguments of `learner judge`, `learner export` and `learner export-data`.

use std::path::PathBuf;

use clap::{Args, value_parser};

pub(super) const JUDGE_EXAMPLES: &str = "\
Examples:
  # Which of these five policies is to be tried first on the robot?
  learner judge runs/iql runs/xql runs/dql runs/quad runs/dtql

  # Where did this run begin to get worse?
  learner judge runs/quad/snapshots/*.safetensors

This is a ranking, not a score: values are estimated from the data alone, by fitted Q evaluation. The learner says when it cannot
rank the policies (docs/deploying.md). It keeps what it finds in the runs' folders, for `learner report`, and the same command does
not compute it again.";

pub(super) const EXPORT_EXAMPLES: &str = "\
Examples:
  # The snapshot with the best evaluation, to be carried to a robot.
  learner export runs/mine --step best --out policy.safetensors

  # What the file says of itself.
  python -c \"import quad_rl; print(quad_rl.Policy.load('policy.safetensors').about)\"

`evaluator score`, `quad_rl.Policy.load` and `quad_rl.export_onnx` read the file (docs/deploying.md).";

#[derive(Debug, Args)]
pub struct JudgeArgs {
    /// Folders of runs, of which the last snapshot is judged, or snapshots, like
    /// RUN/snapshots/step_000020000.safetensors; all of runs on the same data
    #[arg(value_name = "RUN|SNAPSHOT", required = true)]
    pub policies: Vec<PathBuf>,
    /// The data that the runs have learned from, if it is not where they found it; repeatable, in
    /// their order
    #[arg(long, value_name = "FILE|NAME")]
    pub dataset: Vec<String>,
    /// Gradient steps of each evaluation, at least 100
    #[arg(long, value_name = "N", default_value_t = 30_000, value_parser = value_parser!(u64).range(100..))]
    pub steps: u64,
    /// Evaluations of each policy, 2 to 16, from seeds 0, 1, …
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = value_parser!(u64).range(2..=16))]
    pub seeds: u64,
    /// Print JSON instead of a table
    #[arg(long)]
    pub json: bool,
}

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
        number => match number.parse() {
            Ok(step) => Ok(At::Step(step)),
            Err(_) => Err(format!("{number} is no step, and neither best nor last")),
        },
    }
}
