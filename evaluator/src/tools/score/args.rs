//! The arguments of `evaluator score`.

use std::path::PathBuf;

use clap::{Args, value_parser};
use quad_dataset::EnvironmentSpec;
use quad_dataset::environment;
use quad_policy::{Choice, Precision, Reduce, Rule};

/// Most episodes: far above any use, but few enough for memory.
pub const MOST_EPISODES: i64 = 10_000;
/// [`Choice::MOST_CANDIDATES`], in clap's type.
const MOST_CANDIDATES: i64 = Choice::MOST_CANDIDATES as i64;

const AFTER_HELP: &str = "\
Examples:
  # The scores that the run has, measured again.
  evaluator score runs/mine/snapshots/step_000020000.safetensors

  # What does choosing the best of ten actions gain? The same hundred episodes, first without the choice, then with it.
  evaluator score runs/mine/snapshots/step_000020000.safetensors --episodes 100 --candidates 1,10

  # And what if one of fifty is drawn, the likelier the higher the most pessimistic critic values it?
  evaluator score runs/mine/snapshots/step_000020000.safetensors --candidates 50 --rule softmax:1 --value min

RAYON_NUM_THREADS sets how many processor cores are used; without it, all are.";

/// Score saved policies on this machine alone: any snapshot of any run
///
/// A snapshot says which environment it is for and which episodes its run evaluates it on. Without other options the policy is
/// scored on these, so its scores are those that the run has (if the arithmetic is the same).
#[derive(Args, Debug, Default)]
#[command(after_help = AFTER_HELP)]
pub struct ScoreArgs {
    /// Files that learners have saved, e.g. runs/mine/snapshots/step_000020000.safetensors
    #[arg(value_name = "SNAPSHOT", required = true)]
    pub snapshots: Vec<PathBuf>,
    /// Episodes for each [default: as many as the run's]
    #[arg(long, value_name = "N", value_parser = value_parser!(u32).range(1..=MOST_EPISODES))]
    pub episodes: Option<u32>,
    /// Actions sampled per state, of which one is taken; several numbers, like 1,10, are scored on the same episodes
    /// [default: the snapshot's]
    #[arg(long, value_name = "N,..", value_delimiter = ',', value_parser = value_parser!(u32).range(1..=MOST_CANDIDATES))]
    pub candidates: Vec<u32>,
    /// Which of them is taken: best, softmax:TEMPERATURE (a draw) or nearest (to a value function) [default: the snapshot's]
    #[arg(long, value_name = "RULE")]
    pub rule: Option<Rule>,
    /// What the critics' values of an action count as: mean or min [default: the snapshot's]
    #[arg(long, value_name = "NAME")]
    pub value: Option<Reduce>,
    /// Seed that the episodes follow from, with the snapshot's step [default: the run's]
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Environment to act in [default: the run's]
    #[arg(long, value_name = "NAME", value_parser = environment::find)]
    pub env: Option<&'static EnvironmentSpec>,
    /// Arithmetic of the networks, f32 or bf16, which rounds and is faster on CPUs with AMX or AMD's AVX512-BF16
    #[arg(long, value_name = "NAME", default_value = "f32")]
    pub precision: Precision,
    /// Print a JSON array with every episode
    #[arg(long)]
    pub json: bool,
}
