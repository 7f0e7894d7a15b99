//! `learner`: see `learner --help`.

use std::process::ExitCode;

use clap::Parser;
use quad_learner::cli::Cli;

fn main() -> ExitCode {
    quad_service::choose_threads();
    let cli = Cli::parse();
    quad_service::run_main(quad_service::init_logging(), || quad_learner::command::run(&cli))
}
