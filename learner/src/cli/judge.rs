//! The arguments of `learner judge`.

use std::path::PathBuf;

use clap::{Args, value_parser};

pub(super) const EXAMPLES: &str = "\
Examples:
  # Which of these five policies is to be tried first on the robot?
  learner judge runs/iql runs/xql runs/dql runs/quad runs/dtql

  # Where did this run begin to get worse?
  learner judge runs/quad/snapshots/*.safetensors

This is a ranking, not a score: values are estimated from the data alone, by fitted Q evaluation. The learner says when it cannot
rank the policies (docs/deploying.md). It keeps what it finds in the runs' folders, for `learner report`, and the same command does
not compute it again.";

#[derive(Debug, Args)]
pub struct JudgeArgs {
    /// Folders of runs, of which the last snapshot is judged, or snapshots, like
    /// RUN/snapshots/step_000020000.safetensors; all of runs on the same data
    #[arg(value_name = "RUN|SNAPSHOT", required = true)]
    pub policies: Vec<PathBuf>,
    /// The data that the runs have learned from, if it is not where they found it
    #[arg(long, value_name = "FILE|NAME")]
    pub dataset: Option<String>,
    /// Discount γ of the values, from 0 to below 1
    #[arg(long, value_name = "X", default_value_t = 0.99, value_parser = parse_discount)]
    pub gamma: f32,
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

fn parse_discount(text: &str) -> Result<f32, String> {
    let gamma: f32 = text.parse().map_err(|_| format!("{text} is no number"))?;
    if (0.0..1.0).contains(&gamma) {
        Ok(gamma)
    } else {
        Err(format!("{text} is not from 0 to below 1"))
    }
}
