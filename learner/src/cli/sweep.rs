//! The arguments of `learner sweep`.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, value_parser};
use quad_run::config::tables::parse_assignment;
use quad_runtime::{parse_address, parse_endpoint};
use toml::Table;

pub(super) const EXAMPLES: &str = "\
Examples:
  # All runs of a study.
  learner sweep studies/demo.toml

  # List the runs and their states.
  learner sweep studies/demo.toml --list

  # A part of it: one method on one task, with one seed.
  learner sweep studies/table1.toml --only task=hopper-medium-v2 --only seed=0 --only method=iql

  # All runs, but short ones, into a folder of their own.
  learner sweep studies/table1.toml short --set steps=200 --set eval_interval=100

  # A third of the runs, on each of three machines.
  learner sweep studies/demo.toml --shard 1/3

  # One run, as a task of an array job.
  learner sweep studies/demo.toml --index $SLURM_ARRAY_TASK_ID

Each run is a `learner train` of one thread (RAYON_NUM_THREADS changes that) and logs to runs/STUDY/RUN/learner.log. A run that
fails does not end the others. The same command continues the runs that are not complete. The exit code is 0 if all runs are
complete, 1 if a run has failed, 75 if runs are left for the same command. At Ctrl-C, SIGTERM, SIGHUP or SIGUSR1 the learners
save checkpoints, and the sweep ends within 18 s.";

#[derive(Debug, Args)]
pub struct SweepArgs {
    /// The study: axes whose values are combined, and which combinations are runs
    /// (studies/README.md)
    #[arg(value_name = "STUDY.toml")]
    pub study: PathBuf,
    /// Parent folder of all studies: each run has the folder DIR/STUDY/RUN
    #[arg(value_name = "DIR", default_value = "runs")]
    pub runs: PathBuf,
    /// Print number, name and state of each run, and start none
    #[arg(long)]
    pub list: bool,
    /// Train only runs with this value of an axis: 'task=hopper-*', seed=0; repeatable: a run needs
    /// one of the values given for each axis
    #[arg(long, value_name = "AXIS=VALUE", value_parser = parse_assignment)]
    pub only: Vec<Table>,
    /// Change a key in all runs: steps=200; repeatable. Runs of other settings need another DIR
    #[arg(long, value_name = "KEY=VALUE", value_parser = parse_assignment)]
    pub set: Vec<Table>,
    /// Train only the run with this number, as --list prints it
    #[arg(long, value_name = "N", conflicts_with = "shard")]
    pub index: Option<usize>,
    /// Train only the I-th of N equal parts, e.g. 1/3, 2/3 and 3/3 on three machines
    #[arg(long, value_name = "I/N", value_parser = parse_shard)]
    pub shard: Option<Shard>,
    /// Address of the page, /metrics and /healthz of the run that --index names [default: a free
    /// port]
    #[arg(long, value_name = "ADDR:PORT", value_parser = parse_address, requires = "index")]
    pub http: Option<SocketAddr>,
    /// Runs at a time [default: three for every four cores, so that evaluators have the fourth]
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(1..))]
    pub jobs: Option<u16>,
    /// Number of evaluators to start; they serve all runs and log to DIR/STUDY [default: one for
    /// each core that does not train, at least one; none if no run has evaluations or online episodes]
    #[arg(long, value_name = "N", conflicts_with = "connect")]
    pub evaluators: Option<usize>,
    /// Use the evaluators at this Zenoh router instead, e.g. tcp/router:7447
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    pub connect: Option<String>,
}

/// A part of a study's runs: index of the part, from 0, and number of parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard(usize, usize);

impl Shard {
    /// True if the run with this index belongs to this part.
    pub fn has(self, index: usize) -> bool {
        index % self.1 == self.0
    }
}

fn parse_shard(text: &str) -> Result<Shard, String> {
    let numbers = text.split_once('/').map(|(part, parts)| (part.parse(), parts.parse()));
    match numbers {
        Some((Ok(part), Ok(parts))) if (1..=parts).contains(&part) => Ok(Shard(part - 1, parts)),
        _ => Err("write it like 2/3, the second of three parts".to_owned()),
    }
}
