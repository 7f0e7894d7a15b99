//! `evaluator`: see `evaluator --help`.

use std::process::ExitCode;

use clap::Parser;
use quad_evaluator::cli::Cli;

fn main() -> ExitCode {
    let cli = Cli::parse();
    quad_runtime::run_main(quad_runtime::init_logging(), || cli.run())
}
