//! The command line: what the user typed, with every word that scripts rely on.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use quad_policy::Precision;
use quad_service::parse_endpoint;

use crate::config::{self, Overrides};
use crate::device::Device;

const TRAIN_EXAMPLES: &str = "\
Examples:
  # One box: the learner listens, an evaluator in another terminal connects.
  learner train --preset hopper-demo --dataset data/hopper-demo.hdf5 --listen tcp/127.0.0.1:7447
  evaluator serve --connect tcp/127.0.0.1:7447

  # Behaviour cloning with the same steps: no critic at all.
  learner train --preset hopper-demo --dataset data/hopper-demo.hdf5 --guidance none --candidates 1

Ctrl-C or SIGTERM stops early: snapshots and scores so far stay in the run folder, and the exit code is 1.";

/// Trains a diffusion policy and a critic ensemble from a file of transitions.
#[derive(Debug, Parser)]
#[command(name = "learner", version, arg_required_else_help = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What the learner can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Train on a dataset, publish snapshots, hand out evaluations, keep the run in a folder
    #[command(after_help = TRAIN_EXAMPLES)]
    Train(Box<TrainArgs>),
    /// Print the evaluations of finished or running runs; several folders are summarised over seeds
    Report(ReportArgs),
}

/// Arguments of `learner train`.
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Hyper-parameters: a preset's name, or the path of a file that ends in .toml
    #[arg(long, value_name = "NAME", value_parser = parse_preset)]
    pub preset: String,
    /// HDF5 file in D4RL's layout (`evaluator collect` records one)
    #[arg(long, value_name = "FILE")]
    pub dataset: PathBuf,
    /// Folder of this run; its last part names the run [default: runs/PRESET-VARIANT-seedSEED]
    #[arg(long, value_name = "DIR")]
    pub run_dir: Option<PathBuf>,
    /// Listen for evaluators here, e.g. tcp/127.0.0.1:7447, or tcp/0.0.0.0:7447 for other machines
    /// [default: tcp/127.0.0.1:7447; any free port with --eval-interval 0]
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint, conflicts_with = "connect")]
    pub listen: Option<String>,
    /// Join a Zenoh router instead, where evaluators are found, e.g. tcp/router:7447
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    pub connect: Option<String>,
    /// Serve /metrics and /healthz here; port 0 takes a free one (see DIR/endpoints.json)
    #[arg(long, value_name = "ADDR:PORT", default_value = "127.0.0.1:0")]
    pub metrics: SocketAddr,
    /// Train on the CPU, or on the first Nvidia GPU, with a learner that was built by deploy/cuda.sh
    #[arg(long, value_name = "cpu|cuda", value_enum, hide_possible_values = true, default_value_t)]
    pub device: Device,
    #[command(flatten)]
    overrides: OverrideArgs,
}

/// Flags that take the place of a preset's value.
#[derive(Debug, Args)]
#[command(next_help_heading = "Instead of the preset's value")]
struct OverrideArgs {
    /// Gradient steps
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    steps: Option<u64>,
    /// Gradient steps between two evaluations; 0 trains without any evaluation
    #[arg(long, value_name = "N")]
    eval_interval: Option<u64>,
    /// Episodes per evaluation
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    episodes: Option<u32>,
    /// Seed of initial weights, batches, noise and the evaluations' episodes
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// What pulls the policy away from the data: quad (Q-gradients weighted by the critics' agreement),
    /// dac (Q-gradients as they are) or none (behaviour cloning)
    #[arg(long, value_name = "quad|dac|none")]
    guidance: Option<String>,
    /// Actions sampled per next state for the critics' target
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    samples: Option<u32>,
    /// Actions that an evaluated policy samples per state; the critics choose the best
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    candidates: Option<u32>,
    /// Arithmetic of what no gradient is taken of, f32 or bf16: the latter is faster on CPUs with AMX or AMD's AVX512-BF16, and rounds
    #[arg(long, value_name = "NAME")]
    precision: Option<Precision>,
}

impl TrainArgs {
    /// The flags that were given in place of the preset's values.
    pub fn overrides(&self) -> Overrides {
        let OverrideArgs { steps, eval_interval, episodes, seed, samples, candidates, precision, .. } = self.overrides;
        let guidance = self.overrides.guidance.clone();
        Overrides { steps, eval_interval, episodes, seed, guidance, samples, candidates, precision }
    }
}

/// Arguments of `learner report`.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Run folders
    #[arg(value_name = "DIR", required = true)]
    pub dirs: Vec<PathBuf>,
    /// Print JSON instead of a table
    #[arg(long)]
    pub json: bool,
    /// Also draw the learning curves of all the folders into one SVG file
    #[arg(long, value_name = "FILE")]
    pub plot: Option<PathBuf>,
}

fn parse_preset(text: &str) -> Result<String, String> {
    if text.ends_with(".toml") || config::embedded_preset(text).is_some() {
        return Ok(text.to_owned());
    }
    let known: Vec<_> = config::PRESETS.iter().map(|(name, _)| *name).collect();
    Err(format!("presets are {}; a file of your own must end in .toml", known.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    fn parse(arguments: &[&str]) -> Result<Cli, clap::Error> {
        Cli::try_parse_from(
            ["learner", "train", "--preset", "hopper-demo", "--dataset", "d.hdf5"].iter().chain(arguments),
        )
    }

    #[test]
    fn definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn flags_become_overrides() {
        let flags =
            ["--steps", "7", "--eval-interval", "0", "--guidance", "dac", "--samples", "3", "--candidates", "4"];
        let Command::Train(train) = parse(&flags).unwrap().command else { panic!("not train") };
        let overrides = train.overrides();
        assert_eq!((overrides.steps, overrides.eval_interval, overrides.samples), (Some(7), Some(0), Some(3)));
        assert_eq!((overrides.guidance, overrides.candidates, overrides.seed), (Some("dac".to_owned()), Some(4), None));
    }

    #[test]
    fn wrong_command_lines_exit_with_2() {
        let wrong: [&[&str]; 7] = [
            &["--steps", "0"],
            &["--candidates", "0"],
            &["--listen", "127.0.0.1:7447"],
            &["--listen", "tcp/127.0.0.1:1", "--connect", "tcp/127.0.0.1:2"],
            &["--metrics", "9090"],
            &["--device", "tpu"],
            &["--nonsense"],
        ];
        for flags in wrong {
            assert_eq!(parse(flags).unwrap_err().exit_code(), 2, "{flags:?}");
        }
        let unknown = Cli::try_parse_from(["learner", "train", "--preset", "walker", "--dataset", "d"]).unwrap_err();
        assert!(unknown.to_string().contains("hopper-demo"), "{unknown}");
    }
}
