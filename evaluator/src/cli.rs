//! The command line.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context;
use clap::{Args, CommandFactory, Parser, Subcommand};
use clap_complete::Shell;
use quad_dataset::environment::{self, EnvironmentSpec};
use quad_runtime::{Hint, certificates_folder, json, print};

use crate::doctor::{self, DoctorArgs};
use crate::serve::{self, ServeArgs};
use crate::sim::Simulations;
use crate::tools::collect::{self, CollectArgs};
use crate::tools::film::{self, FilmArgs};
use crate::tools::score::{self, ScoreArgs};
use crate::tools::verify;

/// Runs policies in MuJoCo, and records datasets there.
#[derive(Debug, Parser)]
#[command(name = "evaluator", version, arg_required_else_help = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Serve(ServeArgs),
    Score(ScoreArgs),
    Film(FilmArgs),
    Collect(CollectArgs),
    VerifyDataset(VerifyArgs),
    Doctor(DoctorArgs),
    /// Print a script that lets a shell complete this program's arguments
    Completions {
        /// The shell
        shell: Shell,
    },
}

/// Replay a recorded file one step at a time from its own states, and measure how far the
/// simulation is from it
///
/// The file needs infos/qpos, infos/qvel and, for a maze, infos/goal in addition to the arrays for
/// learning. Without next_observations, the replay compares with the observation of the following
/// row of the same episode. The exit code is 1 if rewards or terminals differ. A reward differs if
/// it is more than 0.001 (relative, for rewards above 1) from the recorded one, and further than
/// the next observation, which rounding to float32 cannot explain.
#[derive(Debug, Args)]
struct VerifyArgs {
    /// File to replay
    file: PathBuf,
    /// Environment of the recording [default: the one that the file names, or the only environment
    /// of its sizes]
    #[arg(long, value_name = "NAME", value_parser = environment::find)]
    env: Option<&'static EnvironmentSpec>,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

impl Cli {
    pub fn run(self) -> anyhow::Result<()> {
        // Rayon's own first use panics if the system refuses the threads.
        let threads = rayon::ThreadPoolBuilder::new().build_global();
        let threads = threads.context("cannot start the threads");
        threads.hint("ask for fewer by RAYON_NUM_THREADS")?;
        match self.command {
            Command::Serve(mut args) => {
                args.certificates = certificates_folder(args.certificates);
                serve::serve(args, Arc::new(Simulations))
            }
            Command::Score(args) => print(&score::score(&args)?),
            Command::Film(args) => print(&film::film(&args)?),
            Command::Collect(args) => {
                let summary = collect::collect(&args)?;
                print(&format!("{}: {summary}", args.out.display()))
            }
            Command::VerifyDataset(args) => {
                let spec = args.env.map_or_else(|| verify::environment_of(&args.file), Ok);
                let report = spec.and_then(|spec| verify::verify(&args.file, spec))?;
                let text = if args.json { json(&report)? } else { report.to_string() };
                print(&text)?;
                let differ = report.rewards_differ + report.terminals_differ;
                anyhow::ensure!(differ == 0, "the simulation differs from the file");
                Ok(())
            }
            Command::Doctor(args) => {
                let findings = doctor::examine(&args)?;
                print(&if args.json { json(&findings)? } else { findings.to_string() })?;
                Ok(findings.verdict()?)
            }
            Command::Completions { shell } => {
                let mut script = Vec::new();
                clap_complete::generate(shell, &mut Cli::command(), "evaluator", &mut script);
                print(&String::from_utf8_lossy(&script))
            }
        }
    }
}
