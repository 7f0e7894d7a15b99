//! The command line.

use clap::{Parser, Subcommand};

/// Runs policies in MuJoCo, and records datasets there.
#[derive(Debug, Parser)]
#[command(version, arg_required_else_help = true)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {}
