//! The command line of `evaluator score`.

use std::path::PathBuf;

use clap::{Args, value_parser};
use quad_dataset::environment::{self, EnvironmentSpec};
use quad_policy::{Aggregate, Choice, Precision, Rule};

/// Most episodes: far above any use, but few enough for memory.
pub(super) const MOST_EPISODES: i64 = 10_000;
/// [`Choice::MOST_CANDIDATES`], in clap's type.
const MOST_CANDIDATES: i64 = Choice::MOST_CANDIDATES as i64;

const AFTER_HELP: &str = "\
Examples:
  # Measure the run's own scores again.
  evaluator score runs/mine/snapshots/step_000020000.safetensors

  # What is the gain of the best of ten actions? A hundred episodes with one action per state, and again with ten.
  evaluator score runs/mine/snapshots/step_000020000.safetensors --episodes 100 --candidates 1,10

  # Draw one of fifty actions, with the softmax of the critics' smallest value.
  evaluator score runs/mine/snapshots/step_000020000.safetensors --candidates 50 --rule softmax:1 --aggregate min

RAYON_NUM_THREADS sets the number of processor cores; the default is all.";

/// Score saved policies (snapshots of any run) on this machine
///
/// A snapshot names its environment and the episodes on which its run evaluates it. Without other
/// options the policy runs these episodes, so its scores equal those of the run (with the same
/// arithmetic).
#[derive(Args, Debug, Default)]
#[command(after_help = AFTER_HELP)]
pub struct ScoreArgs {
    /// Snapshots, e.g. runs/mine/snapshots/step_000020000.safetensors
    #[arg(value_name = "SNAPSHOT", required = true)]
    pub snapshots: Vec<PathBuf>,
    /// Episodes per snapshot [default: as many as the run's]
    #[arg(long, value_name = "N", value_parser = value_parser!(u32).range(1..=MOST_EPISODES))]
    pub episodes: Option<u32>,
    /// Actions sampled per state, of which the policy takes one; several numbers, like 1,10, are
    /// scored on the same episodes [default: the snapshot's]
    #[arg(long, value_name = "N,..", value_delimiter = ',', value_parser = value_parser!(u32).range(1..=MOST_CANDIDATES))]
    pub candidates: Vec<u32>,
    /// Rule of choice among the sampled actions: best, softmax:TEMPERATURE (a draw),
    /// average:TEMPERATURE:ACTIONS (the mean of several draws) or nearest (to a value function)
    /// [default: the snapshot's]
    #[arg(long, value_name = "RULE")]
    pub rule: Option<Rule>,
    /// Combination of the critics' values of an action: mean, min or mean-minus-std:KAPPA (the mean
    /// less KAPPA standard deviations) [default: the snapshot's]
    #[arg(long, value_name = "NAME")]
    pub aggregate: Option<Aggregate>,
    /// Strength at which the critics' gradients guide a diffusion policy as it draws an action, per
    /// unit of their values; 0 is none [default: the snapshot's]
    #[arg(long, value_name = "W")]
    pub guidance: Option<f32>,
    /// Seed from which, with the snapshot's step, the episodes' seeds follow [default: the run's]
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Environment to act in [default: the run's]
    #[arg(long, value_name = "NAME", value_parser = environment::find)]
    pub env: Option<&'static EnvironmentSpec>,
    /// Precision of the networks: f32, or bf16, which rounds and is faster on CPUs with AMX or
    /// AMD's AVX512-BF16
    #[arg(long, value_name = "NAME", default_value = "f32")]
    pub precision: Precision,
    /// Print a JSON array with every episode
    #[arg(long)]
    pub json: bool,
}
