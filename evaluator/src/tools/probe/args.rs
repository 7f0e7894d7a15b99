//! The arguments of `evaluator probe`.

use std::path::PathBuf;

use clap::{Args, value_parser};

/// Most states, rollouts and steps: far above any use, but few enough for memory.
const MOST: i64 = 10_000;

const AFTER_HELP: &str = "\
Examples:
  # Are the critics' gradients wrong where the critics disagree? Do they choose good actions?
  evaluator probe runs/mine --step 20000

  # In a maze a reward comes late.
  evaluator probe runs/maze --step 20000 --states 32 --length 400

RAYON_NUM_THREADS sets the number of processor cores; the default is all.";

/// Compare a run's critics with true values, measured in the simulator
///
/// A state is drawn from each of several episodes of the run's policy. An action's true value is a
/// mean over rollouts: from that state the action comes first, then one sample of the policy in each
/// state, as the critics' targets assume. Rollouts that are compared have the same noise.
///
/// The first tables are about noisy actions, where the critics' gradients guide the policy: the
/// risk of weights (Eq. 14 of the paper), and errors beside the critics' disagreement. The last are
/// about the choice among candidates.
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct ProbeArgs {
    /// Folder of a run of QUAD or one of its variants
    #[arg(value_name = "RUN")]
    pub run: PathBuf,
    /// Gradient step of the snapshot
    #[arg(long, value_name = "N")]
    pub step: u64,
    /// Number of states
    #[arg(long, value_name = "N", default_value = "64", value_parser = value_parser!(u32).range(2..=MOST))]
    pub states: u32,
    /// Rollouts per action
    #[arg(long, value_name = "N", default_value = "8", value_parser = value_parser!(u32).range(2..=MOST))]
    pub rollouts: u32,
    /// Steps of a rollout
    #[arg(long, value_name = "N", default_value = "100", value_parser = value_parser!(u32).range(1..=MOST))]
    pub length: u32,
    /// Distance of an action to either side, for the central difference
    #[arg(long, value_name = "X", default_value = "0.1", value_parser = distance)]
    pub h: f32,
    /// κ of mean − κ·std, a lower confidence bound by which candidates are chosen
    #[arg(long, value_name = "X", default_value = "1")]
    pub kappa: f64,
    /// Dataset to which the distance of chosen actions is measured [default: the run's, if the file
    /// is there]
    #[arg(long, value_name = "PATH")]
    pub dataset: Option<PathBuf>,
    /// Seed of states and noise
    #[arg(long, value_name = "N", default_value = "0")]
    pub seed: u64,
    /// Print one JSON object
    #[arg(long)]
    pub json: bool,
}

fn distance(text: &str) -> Result<f32, &'static str> {
    let number = text.parse().ok().filter(|h: &f32| *h > 0.0 && *h < 1.0);
    number.ok_or("a number between 0 and 1")
}
