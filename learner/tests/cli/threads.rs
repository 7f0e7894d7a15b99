//! The threads of a learner at work are those that docs/architecture.md describes.

use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::write_dataset;

/// The first column of the table.
fn described() -> BTreeSet<String> {
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/architecture.md")).unwrap();
    let (_, section) = text.split_once("\n## The learner's threads\n").unwrap();
    let (section, _) = section.split_once("\n## ").unwrap();
    section.lines().filter_map(|line| Some(line.strip_prefix("| `")?.split_once('`')?.0.to_owned())).collect()
}

#[test]
fn the_threads_of_a_learner_are_those_of_the_table() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, run) = (folder.path().join("tiny.hdf5"), folder.path().join("run"));
    write_dataset(&dataset);
    let mut learner = Command::new(env!("CARGO_BIN_EXE_learner"))
        .args(["train", "--task", "hopper-demo", "--steps", "100000000", "--eval-interval", "50000000"])
        .args(["--set", "batch_size=4", "--agent", "actor.hidden=[8]", "--agent", "critic.hidden=[8]"])
        .args(["--listen", "tcp/127.0.0.1:0", "--dataset"])
        .args([&dataset, Path::new("--run-dir"), &run])
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let start = Instant::now();
    while !run.join("endpoints.json").exists() {
        assert!(start.elapsed() < Duration::from_secs(60) && learner.try_wait().unwrap().is_none(), "it never listens");
        std::thread::sleep(Duration::from_millis(50));
    }
    let tasks = std::fs::read_dir(format!("/proc/{}/task", learner.id())).unwrap();
    let name = |task: std::fs::DirEntry| std::fs::read_to_string(task.path().join("comm")).ok();
    let names: BTreeSet<_> = tasks.flatten().filter_map(name).map(|name| name.trim().to_owned()).collect();
    learner.kill().unwrap();
    learner.wait().unwrap();
    // Zenoh's (accepting, receiving, sending), tokio's, and the one that writes log lines. Rayon's bear the name of `training`.
    let library = |name: &str| ["acc-", "rx-", "tx-", "tokio", "log"].iter().any(|prefix| name.starts_with(prefix));
    let ours = names.into_iter().filter(|name| !library(name));
    // The main thread has the program's name.
    let ours: BTreeSet<_> = ours.map(|name| if name == "learner" { "main".to_owned() } else { name }).collect();
    assert_eq!(ours, described());
}
