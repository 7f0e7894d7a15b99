//! `learner presets`, `learner report` and `learner verify`, as a user calls them on files that a test has made up.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod presets;
mod report;
mod run;
mod threads;
mod verify;

use std::process::{Command, Output};

fn learner(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_learner")).args(arguments).output().unwrap()
}

/// What a command prints that must succeed.
fn printed(arguments: &[&str]) -> String {
    let output = learner(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}
