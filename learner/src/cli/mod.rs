//! The command line: what the user typed, with every word that scripts rely on.

mod sweep;
mod train;

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use clap_complete::Shell;
use quad_dataset::{EnvironmentSpec, environment};
use quad_service::parse_endpoint;

use crate::config::{hyperparameters, presets, tasks};
use crate::report::Select;

pub use sweep::{Shard, SweepArgs};
pub use train::TrainArgs;

const FETCH_NOTE: &str = "\
The file goes where D4RL keeps it: $D4RL_DATASET_DIR, or ~/.d4rl/datasets. The learner tries $QUAD_DATASETS_URL, the address of
a folder, first. It continues what a broken connection left, also the next time.";

const DOCTOR_NOTE: &str = "\
The learner prints a line per check: ok, warn or FAIL, with a hint where you can do something. The exit code is 1 if a check
failed.";

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
    #[command(after_help = train::EXAMPLES)]
    Train(Box<TrainArgs>),
    /// Do all runs of a study: many methods, tasks and seeds, several at a time, resumed by the same command
    #[command(after_help = sweep::EXAMPLES)]
    Sweep(SweepArgs),
    /// List tasks and algorithms, or print every value that an algorithm has for a task
    Presets(PresetsArgs),
    /// Datasets: list the names, fetch one, inspect a file
    #[command(subcommand)]
    Datasets(DatasetsCommand),
    /// List all runs: what each is, how far it is, its last score, its size, and whether a learner is at work on it
    List(ListArgs),
    /// Serve a page on which a browser lists all runs, finished and at work, and compares those that are ticked
    Page(PageArgs),
    /// Print the scores of finished or running runs, statistics over seeds and tasks, and the paper's tables with ours beside them
    Report(ReportArgs),
    /// Check by a run's folder alone that each episode is scored once, with the weights that are kept there
    Verify(VerifyArgs),
    /// Check that this machine is fit for a run, and say how to mend what is not
    Doctor(DoctorArgs),
    /// Print a script by which a shell completes this program's arguments
    Completions {
        /// The shell
        shell: Shell,
    },
}

/// Arguments of `learner presets`.
#[derive(Debug, Args)]
pub struct PresetsArgs {
    /// Print every value for this task, or for what a file changes of one, as a file of your own could have them
    #[arg(value_name = "TASK|FILE", value_parser = parse_preset)]
    pub preset: Option<String>,
    /// Algorithm whose values these are [default: quad, or what the file says]
    #[arg(long, value_name = "NAME", value_parser = parse_algorithm, requires = "preset")]
    pub algorithm: Option<String>,
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
    /// Print what is in a dataset and what is wrong with it, before you spend a day of training on it
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
    /// The router that the run is to join; without it, the learner checks that it can listen at its usual port
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

/// Arguments of `learner list`.
#[derive(Debug, Args)]
pub struct ListArgs {
    /// Run folders, or folders with runs below them
    #[arg(value_name = "DIR", default_value = "runs")]
    pub dirs: Vec<PathBuf>,
    /// Print a JSON array of objects instead of a table
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `learner page`.
#[derive(Debug, Args)]
pub struct PageArgs {
    /// Run folder, or folder with runs below it
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub runs: PathBuf,
    /// Serve it here; port 0 takes a free one
    #[arg(long, value_name = "ADDR:PORT", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
}

/// Arguments of `learner report`.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Run folders, or folders with runs below them, whose evaluations are summarised only
    #[arg(value_name = "DIR", required = true)]
    pub dirs: Vec<PathBuf>,
    /// Print JSON instead of tables
    #[arg(long, group = "style")]
    pub json: bool,
    /// Print the summaries as Markdown
    #[arg(long, group = "style")]
    pub markdown: bool,
    /// Print the summaries as LaTeX, whose tables need its package booktabs
    #[arg(long, group = "style")]
    pub latex: bool,
    /// Print the summaries as CSV: tables after one another, with what is said of them as comments
    #[arg(long, group = "style")]
    pub csv: bool,
    /// Which evaluations of a run are its score
    #[arg(long, value_enum, default_value = "last")]
    pub select: Select,
    /// Also write one file with everything, to send or to print: tables, figures, settings, data, films that are in the runs' folders
    /// (film.gif and film.png), and the commands that make the runs again
    #[arg(long, value_name = "FILE.html")]
    pub html: Option<PathBuf>,
    /// Also draw learning curves, performance profiles and scores over τ into this folder, each as SVG and PNG
    #[arg(long, value_name = "DIR")]
    pub figures: Option<PathBuf>,
    /// Also write metrics and scores of each run for TensorBoard, into DIR/RUN
    #[arg(long, value_name = "DIR")]
    pub tensorboard: Option<PathBuf>,
}

fn parse_task(text: &str) -> Result<String, String> {
    tasks::named(text).map(|task| task.name.clone()).map_err(|_| tasks::unknown_hint(text))
}

fn parse_preset(text: &str) -> Result<String, String> {
    if presets::is_path(text) { Ok(text.to_owned()) } else { parse_task(text) }
        .map_err(|hint| hint + "; a file of your own must end in .toml")
}

fn parse_algorithm(text: &str) -> Result<String, String> {
    hyperparameters::algorithm(text).map(|known| known.name.to_owned()).map_err(|_| hyperparameters::unknown_hint(text))
}

#[cfg(test)]
#[path = "../../tests/unit/cli.rs"]
mod tests;
