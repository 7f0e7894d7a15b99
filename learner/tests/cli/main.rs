//! `learner presets`, `list`, `report`, `verify` and `train --dry-run`, as a user calls them on files that a test has made up.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod damaged;
mod dry_run;
mod endless;
mod foreign;
mod list;
mod online;
mod presets;
mod published;
mod report;
mod run;
mod study;
mod verify;

use std::path::Path;
use std::process::{Command, Output};

use quad_dataset::{D4rlWriter, Metadata, Row, environment};

fn learner(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_learner")).args(arguments).output().unwrap()
}

/// What a command prints that must succeed.
fn printed(arguments: &[&str]) -> String {
    let output = learner(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// A small file of Hopper.
fn write_dataset(path: &Path) {
    let mut writer = D4rlWriter::create(path, environment::find("hopper").unwrap()).unwrap();
    for step in 0..100 {
        let observation = |step: usize| [(step as f64 * 0.1).sin(); 11];
        let row = Row {
            observation: &observation(step),
            action: &[0.1, -0.2, 0.3],
            next_observation: &observation(step + 1),
            reward: if step < 50 { 1.0 } else { 2.0 },
            terminal: false,
            timeout: step % 50 == 49,
            qpos: &[0.0; 6],
            qvel: &[0.0; 6],
        };
        writer.push(&row).unwrap();
    }
    writer.finish(&Metadata { algorithm: "made up", iteration: 0, seed: 0 }).unwrap();
}
