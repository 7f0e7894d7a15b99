//! The arguments of `learner sweep`.

use std::path::PathBuf;

use clap::{Args, value_parser};
use quad_service::parse_endpoint;

pub(super) const EXAMPLES: &str = "\
Examples:
  # All runs of a study, as many at a time as the machine has room for.
  learner sweep studies/demo.toml

  # Which runs there are, and how far they are.
  learner sweep studies/demo.toml --list

  # A third of them, on each of three machines.
  learner sweep studies/demo.toml --shard 1/3

  # One of them, as a task of an array job.
  learner sweep studies/demo.toml --index $SLURM_ARRAY_TASK_ID

Each run is a `learner train` of one thread (RAYON_NUM_THREADS changes that) and logs to runs/STUDY/RUN/learner.log. A run that
fails does not end the others. The same command goes on with what is not complete. The exit code is 0 when all is complete, 1
when a run has failed, 75 when the same command goes on.";

/// Arguments of `learner sweep`.
#[derive(Debug, Args)]
pub struct SweepArgs {
    /// What to run: axes whose values are combined, and which combinations (studies/README.md)
    #[arg(value_name = "STUDY.toml")]
    pub study: PathBuf,
    /// Folder of all studies: each run has the folder DIR/STUDY/RUN
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub runs: PathBuf,
    /// Print number, name and state of each run, and start none
    #[arg(long)]
    pub list: bool,
    /// Only the run of this number, as --list prints it
    #[arg(long, value_name = "N", conflicts_with = "shard")]
    pub index: Option<usize>,
    /// Only the I-th of N equal parts, e.g. 1/3, 2/3 and 3/3 on three machines
    #[arg(long, value_name = "I/N", value_parser = parse_shard)]
    pub shard: Option<Shard>,
    /// Runs at a time [default: three of four cores, the fourth being for evaluators]
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(1..))]
    pub jobs: Option<u16>,
    /// Start so many evaluators, which serve all runs and log to DIR/STUDY [default: the cores that no learner has]
    #[arg(long, value_name = "N", conflicts_with = "connect")]
    pub evaluators: Option<usize>,
    /// Use the evaluators at this Zenoh router instead, e.g. tcp/router:7447
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    pub connect: Option<String>,
}

/// A part of a study's runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// Which, from 0.
    part: usize,
    /// Of how many.
    parts: usize,
}

impl Shard {
    /// Whether it has the run of this number.
    pub fn has(self, index: usize) -> bool {
        index % self.parts == self.part
    }
}

fn parse_shard(text: &str) -> Result<Shard, String> {
    let parsed = text.split_once('/').and_then(|(part, parts)| Some((part.parse().ok()?, parts.parse().ok()?)));
    match parsed {
        Some((part, parts)) if (1..=parts).contains(&part) => Ok(Shard { part: part - 1, parts }),
        _ => Err("write it like 2/3, the second of three parts".to_owned()),
    }
}

#[cfg(test)]
#[path = "../../tests/unit/cli/sweep.rs"]
mod tests;
