//! `evaluator`: see `evaluator --help`.

use std::process::ExitCode;

use clap::Parser;
use quad_evaluator::cli::Cli;

fn main() -> ExitCode {
    let cli = Cli::parse();
    quad_service::run_main(quad_service::init_logging(), || cli.run())
}
