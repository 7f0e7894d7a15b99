//! `learner`: see `learner --help`.

use std::process::ExitCode;

use clap::Parser;
use quad_learner::cli::Cli;

fn main() -> ExitCode {
    quad_runtime::choose_threads();
    let cli = Cli::parse();
    quad_runtime::run_main(quad_runtime::init_logging(), || quad_learner::command::run(&cli))
}
