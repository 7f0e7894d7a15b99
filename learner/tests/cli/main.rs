//! `learner presets`, `list`, `report`, `export`, `verify`, `sweep` and `train --dry-run`, as a
//! user calls them on files that a test has made up.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod damaged;
mod dry_run;
mod endless;
mod export;
mod foreign;
#[path = "../../../tests/fixtures/hopper.rs"]
mod hopper;
mod list;
mod presets;
mod published;
mod report;
mod run;
mod study;
mod sweep;
mod verify;

use std::path::Path;
use std::process::{Command, Output};

fn learner(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_learner")).args(arguments).output().unwrap()
}

/// As `learner`, with ten minutes, and of memory a thousandth of what a list of a trillion
/// evaluations would take.
fn bounded(arguments: &[&str]) -> Output {
    let script = "ulimit -v 8000000; exec timeout 600 \"$0\" \"$@\"";
    Command::new("sh")
        .args(["-c", script, env!("CARGO_BIN_EXE_learner")])
        .args(arguments)
        .output()
        .unwrap()
}

/// What a command prints that must succeed.
fn printed(arguments: &[&str]) -> String {
    let output = learner(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// A small file of Hopper.
fn write_dataset(path: &Path) {
    hopper::write_hopper(path, 2, 50);
}
