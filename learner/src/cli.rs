//! The command line: what the user typed, with every word that scripts rely on.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use quad_dataset::{EnvironmentSpec, environment};
use quad_policy::Precision;
use quad_service::parse_endpoint;
use toml::{Table, Value};

use crate::device::Device;
use crate::presets;

const TRAIN_EXAMPLES: &str = "\
Examples:
  # One box: the learner listens, an evaluator in another terminal connects.
  learner train --preset hopper-demo --dataset data/hopper-demo.hdf5 --listen tcp/127.0.0.1:7447
  evaluator serve --connect tcp/127.0.0.1:7447

  # Behaviour cloning with the same steps: no critic at all.
  learner train --preset hopper-demo --dataset data/hopper-demo.hdf5 --guidance none --candidates 1

  # Go on after a crash or Ctrl-C: the same command again.

Ctrl-C or SIGTERM stops early with a checkpoint, and the exit code is 1; a second one ends at once. The same command goes on
from the run folder's newest checkpoint. On the same machine a run that was interrupted ends with the same weights, bit for
bit, as one that was not.";

const FETCH_NOTE: &str = "\
The file goes where D4RL keeps it: $D4RL_DATASET_DIR, or ~/.d4rl/datasets. $QUAD_DATASETS_URL, the address of a folder, is
tried first. What a broken connection leaves is continued the next time.";

const DOCTOR_NOTE: &str = "\
A line per check: ok, warn or FAIL, and a hint where there is something to do. The exit code is 1 if anything failed.";

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
    /// List the presets, or print one with every value that it stands for
    Presets(PresetsArgs),
    /// Datasets by name: list them, fetch one
    #[command(subcommand)]
    Datasets(DatasetsCommand),
    /// Print the evaluations of finished or running runs, summaries over their seeds, and what the paper has for their tasks
    Report(ReportArgs),
    /// Check by a run's folder alone that each episode is scored once, with the weights that are kept there
    Verify(VerifyArgs),
    /// Check this machine before a run is trusted to it, and say what to do about what is wrong
    Doctor(DoctorArgs),
}

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
    /// Seconds between two checkpoints, so many of which a crash may cost; longer where saving would take 1 % of the time
    #[arg(long, value_name = "N", default_value_t = 30)]
    pub checkpoint_seconds: u64,
    /// Share of the episodes, 0 to 1, that another evaluator scores a second time: a score that differs in a bit is reported
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = parse_share)]
    pub audit: f64,
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
    /// Train on the CPU, or on the first Nvidia GPU, with a learner that was built by deploy/cuda.sh
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
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(1..))]
    steps: Option<i64>,
    /// Gradient steps between two evaluations; 0 trains without any evaluation
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(0..))]
    eval_interval: Option<i64>,
    /// Episodes per evaluation
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(1..))]
    episodes: Option<i64>,
    /// Seed of initial weights, batches, noise and the evaluations' episodes
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(0..))]
    seed: Option<i64>,
    /// What pulls the policy away from the data: quad (Q-gradients weighted by the critics' agreement),
    /// dac (Q-gradients as they are) or none (behaviour cloning)
    #[arg(long, value_name = "quad|dac|none")]
    guidance: Option<String>,
    /// Actions sampled per next state for the critics' target
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(1..))]
    samples: Option<i64>,
    /// Actions that an evaluated policy samples per state; the critics choose the best
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(i64).range(1..))]
    candidates: Option<i64>,
    /// Arithmetic of what no gradient is taken of, f32 or bf16: the latter is faster on CPUs with AMX or AMD's AVX512-BF16, and rounds
    #[arg(long, value_name = "NAME")]
    precision: Option<Precision>,
}

impl TrainArgs {
    /// What the command line changes in the preset, where a flag of its own goes before `--set`.
    pub fn changes(&self) -> Table {
        let OverrideArgs { steps, eval_interval, episodes, seed, samples, candidates, .. } = self.overrides;
        let numbers = [
            ("steps", steps),
            ("eval_interval", eval_interval),
            ("episodes", episodes),
            ("seed", seed),
            ("candidates", candidates),
        ];
        let numbers = numbers.map(|(key, value)| (key, value.map(Value::from)));
        let precision = self.overrides.precision.map(|precision| precision.name().into());
        let words = [("dataset", self.dataset.clone().map(Value::from)), ("precision", precision)];
        let guidance = self.overrides.guidance.clone().map(Value::from);
        let agent = table([("guidance", guidance), ("samples", samples.map(Value::from))]);

        let mut changes = Table::new();
        let flags =
            table(numbers.into_iter().chain(words).chain([("agent", (!agent.is_empty()).then(|| agent.into()))]));
        for layer in self.set.iter().cloned().chain([flags]) {
            presets::merge(&mut changes, layer);
        }
        changes
    }
}

fn table(entries: impl IntoIterator<Item = (&'static str, Option<Value>)>) -> Table {
    entries.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?))).collect()
}

/// Arguments of `learner presets`.
#[derive(Debug, Args)]
pub struct PresetsArgs {
    /// Print this preset as a file of your own could have it, all bases merged
    #[arg(value_name = "NAME", value_parser = parse_preset)]
    pub preset: Option<String>,
}

/// What can be done with datasets.
#[derive(Debug, Subcommand)]
pub enum DatasetsCommand {
    /// Print the names that there are, and which of the files are on this machine
    List,
    /// Fetch a dataset unless it is there already, verify it, print its path
    #[command(after_help = FETCH_NOTE)]
    Fetch {
        /// A name of `learner datasets list`
        name: String,
    },
    /// Print what is in a dataset and what is wrong with it, before a day of training is spent on it
    Inspect(InspectArgs),
}

/// Arguments of `learner datasets inspect`.
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// A file or folder of any format, a name of `learner datasets list`, or minari:ID
    #[arg(value_name = "FILE|NAME")]
    pub dataset: String,
    /// Environment that it is for: sizes, time limit and scores are that one's [default: what the dataset says it is from]
    #[arg(long, value_name = "NAME", value_parser = environment::find)]
    pub env: Option<&'static EnvironmentSpec>,
    /// Print JSON instead of a page
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `learner verify`.
#[derive(Debug, Args)]
pub struct VerifyArgs {
    /// Folder of a run that has reached its end
    #[arg(value_name = "DIR")]
    pub dir: PathBuf,
    /// Folder of a run of the same configuration: what both have scored must be equal, bit for bit
    #[arg(long, value_name = "DIR")]
    pub same_as: Option<PathBuf>,
}

/// Arguments of `learner doctor`.
#[derive(Debug, Args)]
#[command(after_help = DOCTOR_NOTE)]
pub struct DoctorArgs {
    /// The router that the run is to join; without it, whether the learner can listen at its usual port is checked
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    pub connect: Option<String>,
    /// Folder of the run that is to begin or to go on
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub run_dir: PathBuf,
    /// Folder with ca.pem, cert.pem and key.pem, for endpoints tls/HOST:PORT (docs/security.md)
    #[arg(long, value_name = "DIR", env = "QUAD_CERTIFICATES")]
    pub certificates: Option<PathBuf>,
    /// Print a JSON array of objects with verdict, check, what and, where there is something to do, hint
    #[arg(long)]
    pub json: bool,
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
    /// Print the summaries as Markdown
    #[arg(long, conflicts_with = "json")]
    pub markdown: bool,
    /// Also draw the learning curves of all the folders into one SVG file
    #[arg(long, value_name = "FILE")]
    pub plot: Option<PathBuf>,
}

fn parse_share(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.0..=1.0).contains(share));
    share.ok_or_else(|| "it must be a number from 0 to 1".to_owned())
}

fn parse_preset(text: &str) -> Result<String, String> {
    if presets::is_path(text) || presets::names().any(|name| name == text) {
        return Ok(text.to_owned());
    }
    let nearest = match presets::nearest(text, presets::names())[..] {
        [] => String::new(),
        ref nearest => format!("did you mean {}? ", nearest.join(", ")),
    };
    Err(format!("{nearest}`learner presets` lists them all; a file of your own must end in .toml"))
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
    fn flags_change_the_preset() {
        let flags = ["--steps", "7", "--eval-interval", "0", "--guidance", "dac", "--set", "agent.samples=2"];
        let Command::Train(train) = parse(&flags).unwrap().command else { panic!("not train") };
        let expected =
            toml::toml! { dataset = "d.hdf5" steps = 7 eval_interval = 0 agent = { guidance = "dac", samples = 2 } };
        assert_eq!(train.changes(), expected);
        let Command::Train(train) = parse(&["--set", "seed=2", "--seed", "3"]).unwrap().command else { panic!() };
        assert_eq!(train.changes(), toml::toml! { dataset = "d.hdf5" seed = 3 });
    }

    #[test]
    fn only_this_machine_sees_the_metrics_unless_told_otherwise() {
        let Command::Train(train) = parse(&[]).unwrap().command else { panic!("not train") };
        assert!(train.metrics.ip().is_loopback(), "{}", train.metrics);
    }

    #[test]
    fn wrong_command_lines_exit_with_2() {
        let wrong: [&[&str]; 10] = [
            &["--audit", "5"],
            &["--steps", "0"],
            &["--candidates", "0"],
            &["--seed", "9223372036854775808"],
            &["--set", "agent.tau"],
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
        assert!(unknown.to_string().contains("walker2d-demo"), "{unknown}");
    }
}
