//! The command line.

mod policies;
mod sweep;
mod train;

use std::ffi::OsStr;
use std::net::SocketAddr;
use std::path::PathBuf;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{Arg, Args, Parser, Subcommand, value_parser};
use clap_complete::Shell;
use quad_algorithms::ALGORITHMS;
use quad_dataset::{EnvironmentSpec, environment};
use quad_run::config::{presets, tasks};
use quad_run::results::Select;
use quad_runtime::{parse_address, parse_endpoint};

pub use policies::{At, ExportArgs, ExportDataArgs, JudgeArgs};
pub use sweep::{Shard, SweepArgs};
pub use train::TrainArgs;

const FETCH_NOTE: &str = "\
The learner writes the file into its benchmark's cache folder: $D4RL_DATASET_DIR or ~/.d4rl/datasets, or ~/.ogbench/data. It tries
$QUAD_DATASETS_URL, the address of a folder, first. After a broken connection it continues the fetch, also the next time.";

const MAKE_NOTE: &str = "\
It writes NAME-random-seed0.hdf5, NAME-medium-replay-seed0.hdf5 (all rows of a training run) and NAME-medium-seed0.hdf5 (a million
rows by that run's last policy) into $QUAD_DATASETS_DIR or ~/.quad/datasets, where --dataset NAME-medium-seed0 finds them; then it
prints their scores beside those of D4RL's files. The run is kept there, too. After Ctrl-C the same command goes on. The files
are the same for any number of evaluators.";

const DOCTOR_NOTE: &str = "\
The learner prints a line per check: ok, warn or FAIL, with a hint if you can do something. The exit code is 1 if a check
failed.";

/// Trains policies offline, from a file of transitions.
#[derive(Debug, Parser)]
#[command(name = "learner", version, arg_required_else_help = true)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Train on a dataset, publish snapshots, give evaluators their jobs, and keep the run in a
    /// folder
    #[command(after_help = train::EXAMPLES)]
    Train(Box<TrainArgs>),
    /// Train all runs of a study (tasks, methods and seeds), several at a time; the same command
    /// continues an interrupted study
    #[command(after_help = sweep::EXAMPLES)]
    Sweep(SweepArgs),
    /// List tasks and algorithms, or print every value of an algorithm for a task
    Presets(PresetsArgs),
    /// List datasets, fetch one, or inspect a file
    #[command(subcommand)]
    Datasets(DatasetsCommand),
    /// List runs with their state, last score and size, and whether a learner is at work on them
    List(ListArgs),
    /// Serve a web page that lists all runs, also while they train, and compares those that you
    /// tick
    Page(PageArgs),
    /// Print scores of runs, statistics over seeds and tasks, and the paper's tables with your runs
    /// in them
    Report(ReportArgs),
    /// Rank policies without a simulator, by what the data alone says of them
    #[command(after_help = policies::JUDGE_EXAMPLES)]
    Judge(JudgeArgs),
    /// Write a policy's file that stands alone: it says what it has learned from and how good it is
    #[command(after_help = policies::EXPORT_EXAMPLES)]
    Export(ExportArgs),
    /// Write the experience of a run, which evaluators played for it, as a dataset
    ExportData(ExportDataArgs),
    /// Check in a run's folder that each episode is scored once, with the weights in that folder
    Verify(VerifyArgs),
    /// Check this machine before a run, and say how to fix what is wrong
    Doctor(DoctorArgs),
    /// Print a script that lets a shell complete this program's arguments
    Completions {
        /// The shell
        shell: Shell,
    },
}

#[derive(Debug, Args)]
pub struct PresetsArgs {
    /// Print every value for this task, or for a preset file of your own, as a complete preset file
    #[arg(value_name = "TASK|FILE", value_parser = parse_preset, group = "what")]
    pub preset: Option<String>,
    /// Print what each algorithm measures, in metrics.jsonl and, with quad_learner_ before the
    /// name, in Prometheus
    #[arg(long, group = "what")]
    pub metrics: bool,
    /// Algorithm [default: quad, or the one in the file; with --metrics all]
    #[arg(long, value_name = "NAME", value_parser = algorithm_names(), hide_possible_values = true, requires = "what")]
    pub algorithm: Option<String>,
}

#[derive(Debug, Subcommand)]
pub enum DatasetsCommand {
    /// Print all names, and which files are on this machine
    List,
    /// Fetch a dataset unless it is on this machine, verify it, and print its path
    #[command(after_help = FETCH_NOTE)]
    Fetch {
        /// A name of `learner datasets list`
        name: String,
    },
    /// Print what a dataset contains and what is wrong with it, before you train on it
    Inspect(InspectArgs),
    /// Make files like D4RL's by its recipe: SAC learns from nothing, and its policies record
    #[command(after_help = MAKE_NOTE)]
    Make(MakeArgs),
}

#[derive(Debug, Args)]
pub struct MakeArgs {
    /// hopper, walker2d or halfcheetah
    #[arg(value_name = "ENVIRONMENT", value_parser = environment::find)]
    pub env: &'static EnvironmentSpec,
    /// Seed of the training and of the recordings
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u32,
    /// Share of D4RL's epochs and rows, for smaller files and worse policies
    #[arg(long, value_name = "SHARE", default_value_t = 1.0, value_parser = parse_scale)]
    pub scale: f64,
    /// Epoch of the medium policy [default: 400 for hopper, 300 for walker2d, 200 for halfcheetah,
    /// times the scale]
    #[arg(long, value_name = "N", value_parser = value_parser!(u64).range(..=100_000))]
    pub epoch: Option<u64>,
    /// Train for 3,000 epochs, which takes a night, for medium-expert and expert, too
    #[arg(long)]
    pub expert: bool,
    /// Number of evaluators to start [default: as `learner train`]
    #[arg(long, value_name = "N", value_parser = value_parser!(u16).range(1..))]
    pub evaluators: Option<u16>,
}

#[derive(Debug, Args)]
#[command(after_help = "The exit code is 1 if something is wrong with the dataset.")]
pub struct InspectArgs {
    /// A file or folder of any format, a name of `learner datasets list`, or minari:ID; several are
    /// one dataset
    #[arg(value_name = "FILE|NAME", required = true)]
    pub datasets: Vec<String>,
    /// Environment that gives sizes, time limit and reference scores [default: the one that the
    /// dataset names]
    #[arg(long, value_name = "NAME", value_parser = environment::find)]
    pub env: Option<&'static EnvironmentSpec>,
    /// Print JSON instead of text
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
#[command(
    after_help = "The exit code is 1 if a promise has not held, or there was nothing to check."
)]
pub struct VerifyArgs {
    /// Folders of complete runs
    #[arg(value_name = "DIR", required = true)]
    pub dirs: Vec<PathBuf>,
    /// Folder of another run of the same configuration: it must have each score and each snapshot
    /// of DIR, bit for bit
    #[arg(long, value_name = "DIR")]
    pub same_as: Option<PathBuf>,
}

#[derive(Debug, Args)]
#[command(after_help = DOCTOR_NOTE)]
pub struct DoctorArgs {
    /// Router that the run will join; without it, the learner checks that it can listen at its
    /// usual port
    #[arg(long, value_name = "ENDPOINT", value_parser = parse_endpoint)]
    pub connect: Option<String>,
    /// Folder of the run, new or existing
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub run_dir: PathBuf,
    /// Folder with ca.pem, cert.pem and key.pem, for endpoints tls/HOST:PORT (docs/security.md)
    /// [default: QUAD_CERTIFICATES]
    #[arg(long, value_name = "DIR")]
    pub certificates: Option<PathBuf>,
    /// Print a JSON array of objects with verdict, check, what and (if you can do something) hint
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
#[command(after_help = "The exit code is 1 if a run cannot be read.")]
pub struct ListArgs {
    /// Run folders, or folders with runs below them
    #[arg(value_name = "DIR", default_value = "runs")]
    pub dirs: Vec<PathBuf>,
    /// Print a JSON array of objects instead of a table
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Args)]
pub struct PageArgs {
    /// Run folder, or folder with runs below it
    #[arg(value_name = "DIR", default_value = "runs")]
    pub runs: PathBuf,
    /// Address of the page; port 0 takes a free one
    #[arg(long, value_name = "ADDR:PORT", value_parser = parse_address, default_value = "127.0.0.1:8080")]
    pub http: SocketAddr,
    /// Further names of that address
    #[arg(long, value_name = "NAME,…", value_delimiter = ',')]
    pub http_hosts: Vec<String>,
}

#[derive(Debug, Args)]
pub struct ReportArgs {
    /// Run folders, or folders with runs below them
    #[arg(value_name = "DIR", required = true)]
    pub dirs: Vec<PathBuf>,
    /// Print JSON instead of tables
    #[arg(long, group = "style")]
    pub json: bool,
    /// Print the tables as LaTeX, which needs the package booktabs
    #[arg(long, group = "style")]
    pub latex: bool,
    /// Evaluations whose mean is a run's score
    #[arg(long, value_enum, default_value = "last")]
    pub select: Select,
    /// Also write one HTML file to send or to print: tables, figures, settings, data, films in the
    /// runs' folders (film.gif and film.png), and the commands that make the runs again
    #[arg(long, value_name = "FILE.html")]
    pub html: Option<PathBuf>,
    /// Also draw learning curves, performance profiles and scores over τ into this folder, each as
    /// SVG and PNG
    #[arg(long, value_name = "DIR")]
    pub figures: Option<PathBuf>,
}

/// Parses the name of a task. Shells complete it; an error has similar names, not all.
#[derive(Clone)]
struct TaskName;

impl TypedValueParser for TaskName {
    type Value = String;

    fn parse_ref(
        &self,
        command: &clap::Command,
        argument: Option<&Arg>,
        value: &OsStr,
    ) -> Result<String, clap::Error> {
        let named = |text: &str| match tasks::named(text) {
            Ok(task) => Ok(task.name.clone()),
            Err(_) if presets::is_path(text) => Err("name a file by --preset".to_owned()),
            Err(error) => Err(error.hint()),
        };
        named.parse_ref(command, argument, value)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(tasks::list().iter().map(|task| PossibleValue::new(&*task.name))))
    }
}

fn parse_scale(text: &str) -> Result<f64, &'static str> {
    let scale = text.parse().ok().filter(|scale| *scale > 0.0 && *scale <= 1.0);
    scale.ok_or("write a share above 0, at most 1")
}

fn algorithm_names() -> PossibleValuesParser {
    ALGORITHMS.iter().map(|definition| definition.name).into()
}

fn parse_preset(text: &str) -> Result<String, String> {
    if presets::is_path(text) || tasks::named(text).is_ok() {
        return Ok(text.to_owned());
    }
    Err(tasks::unknown_hint(text) + "; a file of your own must end in .toml")
}
