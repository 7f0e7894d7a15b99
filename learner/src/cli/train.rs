//! The arguments of `learner train`.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, value_parser};
use quad_policy::Precision;
use quad_run::config::tables::{self, parse_assignment};
use quad_run::config::{ConfigError, Device, Preset, presets};
use quad_runtime::{parse_address, parse_endpoint};
use toml::{Table, Value};

use super::{TaskName, algorithm_names};

pub(super) const EXAMPLES: &str = "\
Examples:
  # One machine: the learner, and the evaluators that it starts.
  learner train --task hopper-demo --dataset data/hopper-demo.hdf5

  # Data of your own, by another algorithm.
  learner train --task own-data --env my-robot --dataset my-robot.hdf5 --normalize actions,observations --algorithm iql

  # From nothing but the episodes that evaluators play.
  learner train --env hopper --algorithm sac

  # QUAD without guidance, which is behavior cloning.
  learner train --task hopper-demo --agent guidance=none --dataset data/hopper-demo.hdf5

  # Print all values of the run, and the time, memory and disk that it will take.
  learner train --task hopper-demo --dataset data/hopper-demo.hdf5 --dry-run

It trains on $RAYON_NUM_THREADS threads, each of which keeps a core busy; by default on one per core, at most 16.
At Ctrl-C, SIGTERM, SIGHUP or SIGUSR1 the learner saves a checkpoint and ends with exit code 75; at a second signal it ends at
once. Then, or after a crash, the same command continues from the newest checkpoint in the run's folder. On the same machine an
interrupted run ends with the same weights, bit for bit, as a run without interruption.";

#[derive(Debug, Args)]
pub struct TrainArgs {
    /// The task: an environment, a dataset, and the algorithm's values for them (`learner presets`
    /// lists tasks; own-data trains on any file, without evaluations) [default: none, with --env]
    #[arg(long, value_name = "NAME", value_parser = TaskName, hide_possible_values = true, required_unless_present_any = ["preset", "from", "env"])]
    task: Option<String>,
    /// The algorithm (`learner presets` lists algorithms) [default: quad]
    #[arg(long, value_name = "NAME", value_parser = algorithm_names(), hide_possible_values = true)]
    algorithm: Option<String>,
    /// A file of your own with `task`, `algorithm` and the values to change
    #[arg(long, value_name = "FILE.toml", value_parser = parse_file, conflicts_with = "task")]
    preset: Option<String>,
    /// Fine-tune a complete run online: with its settings, from its last checkpoint,
    /// in a folder of its own
    #[arg(long, value_name = "RUN", conflicts_with_all = ["task", "preset", "algorithm", "steps"], requires = "online_steps")]
    pub from: Option<PathBuf>,
    /// The environment in which the policy acts; one that no evaluator simulates can be any name
    /// (docs/python.md) [default: the task's]
    #[arg(long, value_name = "NAME")]
    env: Option<String>,
    /// A file (`evaluator collect` records one), a name of `learner datasets list` (fetched if it
    /// is missing), or minari:ID; repeatable: several are one dataset [default: the task's; rlpd and
    /// sac need none]
    #[arg(long, value_name = "FILE|NAME")]
    dataset: Vec<String>,
    /// Normalize some of these: actions from their least and largest value to ±1, observations to
    /// mean 0 and standard deviation 1, rewards to a mean square of 1; the policy still takes and
    /// gives the data's own units
    #[arg(long, value_name = "actions,observations,rewards", value_delimiter = ',', value_parser = ["actions", "observations", "rewards"], hide_possible_values = true)]
    normalize: Vec<String>,
    /// Share of the episodes to keep out of training; losses and values on them are in the metrics,
    /// as held_out_… [default: the task's, 0.1 for own-data, else 0]
    #[arg(long, value_name = "SHARE", value_parser = parse_share)]
    hold_out: Option<f64>,
    /// Folder of the run; its last part names the run. If it contains a run of the same
    /// configuration, that run continues [default: runs/TASK-VARIANT-seedSEED,
    /// runs/TASK-VARIANT-online-seedSEED with --online-steps, runs/RUN-online with --from]
    #[arg(long, value_name = "DIR")]
    pub run_dir: Option<PathBuf>,
    /// Seconds between two checkpoints; a crash loses at most the training since the last one. The
    /// learner waits longer if saving would take 1 % of the time
    #[arg(long, value_name = "N", default_value_t = 30, value_parser = value_parser!(u64).range(..=31_536_000))]
    pub checkpoint_seconds: u64,
    /// Start a new run; a run that is already in the folder is kept under another name
    #[arg(long)]
    pub fresh: bool,
    /// Print every value of the run, and the time, memory and disk that it will take, measured in a
    /// second; train nothing and leave no folder. A missing dataset is fetched
    #[arg(long)]
    pub dry_run: bool,
    /// Listen for evaluators here, e.g. tcp/127.0.0.1:7447, or tls/0.0.0.0:7447 for other machines
    /// [default: tcp/127.0.0.1:7447, or tls/… with --certificates; a free port if nothing is
    /// evaluated, or if that one is taken and the learner starts evaluators]
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint, conflicts_with = "connect")]
    pub listen: Option<String>,
    /// Join a Zenoh router instead, at which evaluators are found, e.g. tcp/router:7447
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    pub connect: Option<String>,
    /// Number of evaluators to start on this machine; they end with the learner, and log to
    /// DIR/evaluator-1.log and so on [default: one for each core that does not train, at least one;
    /// none with --listen, --connect or certificates, nor for an environment of your own]
    #[arg(long, value_name = "N", conflicts_with = "certificates")]
    pub evaluators: Option<usize>,
    /// Folder with ca.pem, cert.pem and key.pem: evaluators must show a certificate of the same
    /// authority, and endpoints are tls/HOST:PORT (docs/security.md) [default: QUAD_CERTIFICATES,
    /// but none with --evaluators]
    #[arg(long, value_name = "DIR")]
    pub certificates: Option<PathBuf>,
    /// Address of the page, /metrics and /healthz; port 0 takes a free one (see DIR/endpoints.json)
    #[arg(long, value_name = "ADDR:PORT", value_parser = parse_address, default_value = "127.0.0.1:0")]
    pub http: SocketAddr,
    /// Further names of that address, such as a service's: learner,learner.lab.svc.cluster.local
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    pub http_hosts: Vec<String>,
    /// Train on the CPU, or on the first Nvidia GPU (with a learner that deploy/cuda.sh has built)
    #[arg(long, value_name = "cpu|cuda", value_enum, hide_possible_values = true, default_value_t)]
    pub device: Device,
    /// Change a hyper-parameter of the algorithm, in TOML's notation: guidance=dac, tau=0.5;
    /// repeatable
    #[arg(long, value_name = "KEY=VALUE", value_parser = parse_hyperparameter)]
    agent: Vec<Table>,
    /// Change any other key: batch_size=64; repeatable
    #[arg(long, value_name = "KEY=VALUE", value_parser = parse_assignment)]
    set: Vec<Table>,
    #[command(flatten)]
    overrides: OverrideArgs,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "Instead of the algorithm's value for the task")]
struct OverrideArgs {
    /// Gradient steps on the dataset; 0 only with --online-steps
    #[arg(long, value_name = "N", value_parser = parse_count)]
    steps: Option<i64>,
    /// Online environment steps, on which the learner fine-tunes
    #[arg(long, value_name = "N", value_parser = parse_count)]
    online_steps: Option<i64>,
    /// Gradient steps between two evaluations; 0 trains without any evaluation
    #[arg(long, value_name = "N", value_parser = parse_count)]
    eval_interval: Option<i64>,
    /// Episodes per evaluation
    #[arg(long, value_name = "N", value_parser = parse_count)]
    episodes: Option<i64>,
    /// Seed of initial weights, batches, noise and the episodes of evaluations
    #[arg(long, value_name = "N", value_parser = parse_count)]
    seed: Option<i64>,
    /// Precision of products between hidden layers: f32, or bf16, which rounds and is faster on
    /// CPUs with AMX or AMD's AVX512-BF16
    #[arg(long, value_name = "NAME")]
    precision: Option<Precision>,
}

impl TrainArgs {
    /// The task, a file of the user's own, or neither.
    pub fn preset(&self) -> Result<Preset, ConfigError> {
        // clap requires one of them, or an environment.
        let without = || Ok(Preset::without_task(self.env.as_deref().unwrap_or_default()));
        self.task.as_deref().or(self.preset.as_deref()).map_or_else(without, Preset::read)
    }

    /// The values that the command line changes: `--agent` overrides `--set`, and other flags
    /// override both.
    pub fn changes(&self) -> Table {
        let mut changes = Table::new();
        for change in self.set.iter().chain(&self.agent) {
            tables::merge(&mut changes, change.clone());
        }
        let flags = &self.overrides;
        if let Some(steps) = flags.online_steps {
            let online = Table::from_iter([("steps".to_owned(), steps.into())]);
            tables::merge(&mut changes, Table::from_iter([("online".to_owned(), online.into())]));
        }
        let [normalize, dataset] = [&self.normalize, &self.dataset]
            .map(|names| Some(names.clone()).filter(|names| !names.is_empty()));
        for (key, value) in [
            ("algorithm", self.algorithm.clone().map(Value::from)),
            ("environment", self.env.clone().map(Value::from)),
            ("dataset", dataset.map(Value::from)),
            ("normalize", normalize.map(Value::from)),
            ("hold_out", self.hold_out.map(Value::from)),
            ("steps", flags.steps.map(Value::from)),
            ("eval_interval", flags.eval_interval.map(Value::from)),
            ("episodes", flags.episodes.map(Value::from)),
            ("seed", flags.seed.map(Value::from)),
            ("precision", flags.precision.map(|precision| precision.name().into())),
        ] {
            changes.extend(value.map(|value| (key.to_owned(), value)));
        }
        changes
    }
}

/// Parses `tau=0.5` as a key below `[agent]`.
fn parse_hyperparameter(text: &str) -> Result<Table, String> {
    let agent = parse_assignment(text)?;
    Ok(Table::from_iter([("agent".to_owned(), agent.into())]))
}

/// Parses a number of steps or episodes, or a seed.
fn parse_count(text: &str) -> Result<i64, &'static str> {
    let count = text.parse().ok().filter(|count| *count >= 0);
    count.ok_or("write a whole number such as 1000000, below 2⁶³")
}

fn parse_file(text: &str) -> Result<String, &'static str> {
    match presets::is_path(text) {
        true => Ok(text.to_owned()),
        false => Err("a file must end in .toml; a task is named by --task"),
    }
}

fn parse_share(text: &str) -> Result<f64, &'static str> {
    text.parse().map_err(|_| "write a share such as 0.1")
}
