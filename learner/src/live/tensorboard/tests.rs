//! Tests of `live/tensorboard.rs`.

use std::process::Command;
use std::time::Instant;

use quad_runs::run::RunDir;

use super::*;
use crate::fixtures::config;

#[test]
fn the_end_of_a_run_copies_what_is_new() {
    let folder = tempfile::tempdir().unwrap();
    let [run, events] = ["a", "events"].map(|name| folder.path().join(name));
    RunDir::create(&run, &config("a", 0)).unwrap();
    let thread = TensorBoard::start(Exporter::new(&run, &events)).unwrap();
    std::fs::write(run.join("metrics.jsonl"), "{\"step\":10,\"seconds\":1.0,\"loss\":0.5}\n").unwrap();
    thread.end();
    let file = std::fs::read_dir(events.join("a")).unwrap().next().unwrap().unwrap().path();
    assert!(std::fs::read(file).unwrap().windows(10).any(|bytes| bytes == b"train/loss"));
}

#[test]
fn a_disk_that_hangs_holds_up_the_end_for_a_few_seconds() {
    let folder = tempfile::tempdir().unwrap();
    // Reading it waits for a writer, and none comes.
    assert!(Command::new("mkfifo").arg(folder.path().join("config.toml")).status().unwrap().success());
    let begin = Instant::now();
    TensorBoard::start(Exporter::new(folder.path(), folder.path())).unwrap().end();
    assert!((PATIENCE..3 * PATIENCE).contains(&begin.elapsed()), "{:?}", begin.elapsed());
}
