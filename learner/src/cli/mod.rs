//! The command line: what the user typed, with every word that scripts rely on.

mod train;

use std::io::{ErrorKind, Write};
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};
use quad_dataset::{EnvironmentSpec, environment};
use quad_service::parse_endpoint;

use crate::config::presets;

pub use train::TrainArgs;

const FETCH_NOTE: &str = "\
The file goes where D4RL keeps it: $D4RL_DATASET_DIR, or ~/.d4rl/datasets. The learner tries $QUAD_DATASETS_URL, the address of
a folder, first. It continues what a broken connection left, also the next time.";

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
    #[command(after_help = train::EXAMPLES)]
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

fn parse_preset(text: &str) -> Result<String, String> {
    if presets::is_path(text) || presets::names().any(|name| name == text) {
        return Ok(text.to_owned());
    }
    Err(presets::unknown_hint(text))
}

/// Prints a result to stdout, where logs do not go. The reader may stop at any time, like `head` does.
pub(crate) fn print(text: &str) -> anyhow::Result<()> {
    match writeln!(std::io::stdout(), "{}", text.trim_end()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        result => Ok(result?),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    pub(super) fn parse(arguments: &[&str]) -> Result<Cli, clap::Error> {
        Cli::try_parse_from(
            ["learner", "train", "--preset", "hopper-demo", "--dataset", "d.hdf5"].iter().chain(arguments),
        )
    }

    #[test]
    fn definition_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn wrong_command_lines_exit_with_2() {
        let wrong: [&[&str]; 10] = [
            &["--audit", "0.5"],
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
