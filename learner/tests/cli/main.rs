//! The learner's commands, as a user calls them on files that a test has made up.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod export;
mod foreign;
#[path = "../../../tests/fixtures/hopper.rs"]
mod hopper;
mod report;
mod run;
mod signals;
mod transcripts;

use std::path::Path;
use std::process::{Command, Output};

/// Runs a command line whose words have no spaces in them.
fn learner(words: &str) -> Output {
    Command::new(env!("CARGO_BIN_EXE_learner")).args(words.split_whitespace()).output().unwrap()
}

fn printed(words: &str) -> String {
    let output = learner(words);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{words}: {said}");
    String::from_utf8(output.stdout).unwrap()
}

fn write_dataset(path: &Path) {
    hopper::write_hopper(path, 2, 50);
}
