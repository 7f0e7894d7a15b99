//! The arguments of `learner train`.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, value_parser};
use quad_policy::Precision;
use quad_service::parse_endpoint;
use toml::{Table, Value};

use super::parse_preset;
use crate::config::{Device, presets};

pub(super) const EXAMPLES: &str = "\
Examples:
  # One box: the learner listens, an evaluator in another terminal connects.
  learner train --preset hopper-demo --dataset data/hopper-demo.hdf5 --listen tcp/127.0.0.1:7447
  evaluator serve --connect tcp/127.0.0.1:7447

  # Behaviour cloning with the same steps: no critic at all.
  learner train --preset hopper-demo --dataset data/hopper-demo.hdf5 --guidance none --candidates 1

  # Go on after a crash or Ctrl-C: the same command again.

At Ctrl-C or SIGTERM the learner saves a checkpoint and ends with exit code 1; at a second one it ends at once. The same
command goes on from the run folder's newest checkpoint. On the same machine a run that was interrupted ends with the same
weights, bit for bit, as one that was not.";

/// Arguments of `learner train`.
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Hyper-parameters: a preset's name (`learner presets` lists them), or the path of a file that ends in .toml
    #[arg(long, value_name = "NAME", value_parser = parse_preset)]
    pub preset: String,
    /// A file (`evaluator collect` records one), a name of `learner datasets list`, fetched if it is not there yet,
    /// or minari:ID [default: the preset's]
    #[arg(long, value_name = "FILE|NAME")]
    dataset: Option<String>,
    /// Folder of this run; its last part names the run. A run of the same configuration that is there already goes on
    /// [default: runs/PRESET-VARIANT-seedSEED]
    #[arg(long, value_name = "DIR")]
    pub run_dir: Option<PathBuf>,
    /// Seconds between two checkpoints, which is what a crash may cost; more where saving would take 1 % of the time
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = value_parser!(u64).range(..=31_536_000))]
    pub checkpoint_seconds: u64,
    /// Begin anew: a run that is in the folder already is kept under another name
    #[arg(long)]
    pub fresh: bool,
    /// Listen for evaluators here, e.g. tcp/127.0.0.1:7447, or tls/0.0.0.0:7447 for other machines
    /// [default: tcp/127.0.0.1:7447, or tls/… with --certificates; any free port with --eval-interval 0]
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint, conflicts_with = "connect")]
    pub listen: Option<String>,
    /// Join a Zenoh router instead, where evaluators are found, e.g. tcp/router:7447
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    pub connect: Option<String>,
    /// Folder with ca.pem, cert.pem and key.pem: evaluators must show a certificate of the same authority, and endpoints
    /// are tls/HOST:PORT (docs/security.md)
    #[arg(long, value_name = "DIR", env = "QUAD_CERTIFICATES")]
    pub certificates: Option<PathBuf>,
    /// Serve /metrics and /healthz here; port 0 takes a free one (see DIR/endpoints.json)
    #[arg(long, value_name = "ADDR:PORT", default_value = "127.0.0.1:0")]
    pub metrics: SocketAddr,
    /// Train on the CPU, or on the first Nvidia GPU, which needs a learner that deploy/cuda.sh has built
    #[arg(long, value_name = "cpu|cuda", value_enum, hide_possible_values = true, default_value_t)]
    pub device: Device,
    /// Any other value of the preset, in TOML's notation: agent.tau=0.5, environment=my-robot; repeatable
    #[arg(long, value_name = "KEY=VALUE", value_parser = presets::parse_assignment)]
    set: Vec<Table>,
    #[command(flatten)]
    overrides: OverrideArgs,
}

/// Flags that take the place of a preset's value.
#[derive(Debug, Args)]
#[command(next_help_heading = "Instead of the preset's value")]
struct OverrideArgs {
    /// Gradient steps
    #[arg(long, value_name = "N", value_parser = value_parser!(i64).range(1..))]
    steps: Option<i64>,
    /// Gradient steps between two evaluations; 0 trains without any evaluation
    #[arg(long, value_name = "N", value_parser = value_parser!(i64).range(0..))]
    eval_interval: Option<i64>,
    /// Episodes per evaluation
    #[arg(long, value_name = "N", value_parser = value_parser!(i64).range(1..))]
    episodes: Option<i64>,
    /// Seed of initial weights, batches, noise and the evaluations' episodes
    #[arg(long, value_name = "N", value_parser = value_parser!(i64).range(0..))]
    seed: Option<i64>,
    /// What pulls the policy away from the data: quad (Q-gradients weighted by the critics' agreement),
    /// dac (Q-gradients as they are) or none (behaviour cloning)
    #[arg(long, value_name = "quad|dac|none")]
    guidance: Option<String>,
    /// Actions sampled per next state for the critics' target
    #[arg(long, value_name = "N", value_parser = value_parser!(i64).range(1..))]
    samples: Option<i64>,
    /// Actions that an evaluated policy samples per state; the critics choose the best
    #[arg(long, value_name = "N", value_parser = value_parser!(i64).range(1..))]
    candidates: Option<i64>,
    /// Precision of forward passes without gradient, f32 or bf16, which rounds and is faster on CPUs with AMX or AVX512-BF16
    #[arg(long, value_name = "NAME")]
    precision: Option<Precision>,
}

impl TrainArgs {
    /// What the command line changes in the preset. Where it says a value twice, a flag of its own wins over `--set`.
    pub fn changes(&self) -> Table {
        let flags = &self.overrides;
        let number = |value: Option<i64>| value.map(Value::from);
        let mut changes = Table::new();
        for change in &self.set {
            presets::merge(&mut changes, change.clone());
        }
        for (key, value) in [
            ("dataset", self.dataset.clone().map(Value::from)),
            ("steps", number(flags.steps)),
            ("eval_interval", number(flags.eval_interval)),
            ("episodes", number(flags.episodes)),
            ("seed", number(flags.seed)),
            ("precision", flags.precision.map(|precision| precision.name().into())),
        ] {
            changes.extend(value.map(|value| (key.to_owned(), value)));
        }
        for (key, value) in [
            ("guidance", flags.guidance.clone().map(Value::from)),
            ("samples", number(flags.samples)),
            ("candidates", number(flags.candidates)),
        ] {
            let Some(value) = value else { continue };
            let agent = Table::from_iter([(key.to_owned(), value)]);
            presets::merge(&mut changes, Table::from_iter([("agent".to_owned(), agent.into())]));
        }
        changes
    }
}

#[cfg(test)]
#[path = "../../tests/unit/cli/train.rs"]
mod tests;
