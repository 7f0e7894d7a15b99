//! A run folder as the learner writes it.

use std::fs::File;
use std::os::unix::fs::symlink;
use std::process::Command;
use std::sync::mpsc::channel;
use std::time::Duration;

use super::{Checkpoint, RunDir, RunDirError};
use crate::fixtures::{config, line};

#[test]
fn a_folder_with_a_run_in_it_is_not_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    assert!(!RunDir::is_occupied(&path));
    RunDir::create(&path, &config("a", 0)).unwrap();
    assert!(matches!(RunDir::create(&path, &config("a", 1)), Err(RunDirError::Occupied(_))));
    let (run, found) = RunDir::open(&path).unwrap();
    assert_eq!(found, config("a", 0));

    // Set aside, it is still there, and so is one that was set aside before.
    for _ in 0..2 {
        RunDir::open(&path).unwrap().0.set_aside().unwrap();
        RunDir::create(&path, &config("a", 2)).unwrap();
    }
    assert_eq!(RunDir::open(&folder.path().join("a.old1")).unwrap().1, config("a", 0));
    assert_eq!(RunDir::open(&folder.path().join("a.old2")).unwrap().1, config("a", 2));
    drop(run);
}

/// Both saw that the folder was empty.
#[test]
fn of_two_learners_that_begin_at_once_one_is_refused_and_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    std::fs::create_dir_all(&path).unwrap();
    // What the first one does before it writes the configuration.
    let first = RunDir::create(&path, &config("a", 0)).unwrap();
    std::fs::remove_file(path.join("config.toml")).unwrap();
    assert!(matches!(RunDir::create(&path, &config("a", 1)), Err(RunDirError::InUse(_))));
    assert!(!RunDir::is_occupied(&path));
    drop(first);
    RunDir::create(&path, &config("a", 1)).unwrap();
}

#[test]
fn a_new_run_does_not_take_over_scores_of_unknown_origin() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    RunDir::create(&path, &config("a", 0)).unwrap().1.append(&[line(1, 1, 0.1)]).unwrap();
    std::fs::remove_file(path.join("config.toml")).unwrap();
    assert!(matches!(RunDir::create(&path, &config("a", 1)), Err(RunDirError::Occupied(_))));
}

#[test]
fn one_learner_at_a_time_works_in_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let (run, log) = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap();
    assert!(matches!(run.score_log(), Err(RunDirError::InUse(path)) if path == run.path()));
    drop(log);
    run.score_log().unwrap();
}

/// A sweep leaves the mark. While a learner is at work, the run has not failed.
#[test]
fn a_run_that_begins_or_goes_on_is_no_longer_called_failed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    std::fs::create_dir(&path).unwrap();
    RunDir::at(&path).mark_failed(true).unwrap();
    let (run, log) = RunDir::create(&path, &config("a", 0)).unwrap();
    assert!(!run.has_failed());
    drop(log);
    run.mark_failed(true).unwrap();
    super::open(&path, false).unwrap().unwrap().go_on(&config("a", 0).experiment).unwrap();
    assert!(!run.has_failed());
}

#[test]
fn metrics_of_steps_that_come_again_are_cut_off() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap().0;
    let row =
        |step: u64| serde_json::json!({ "step": step, "seconds": step as f64 / 10.0, "eta": 1.0 });
    let (mut log, seconds) = run.metrics_log(0).unwrap();
    assert_eq!(seconds, 0.0);
    log.append(&[row(100), row(200), row(300)]).unwrap();
    drop(log);
    let (mut log, seconds) = run.metrics_log(250).unwrap();
    assert_eq!(seconds, 20.0);
    log.append(&[row(300)]).unwrap();
    let text = std::fs::read_to_string(run.path().join("metrics.jsonl")).unwrap();
    let steps: Vec<_> = text
        .lines()
        .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap()["step"].clone())
        .collect();
    assert_eq!(steps, [100, 200, 300]);
}

#[test]
fn scores_survive_a_reopened_log_and_an_unfinished_line_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap().0;
    run.score_log().unwrap().append(&[line(1, 1, 0.1)]).unwrap();
    run.score_log().unwrap().append(&[line(1, 2, 0.2)]).unwrap();
    let path = run.path().join("scores.jsonl");
    let mut text = std::fs::read_to_string(&path).unwrap();
    text.push_str("{\"step\":1,");
    std::fs::write(&path, &text).unwrap();
    assert_eq!(run.read_scores().unwrap(), [line(1, 1, 0.1), line(1, 2, 0.2)]);

    // A learner that continues cuts it off first, however long it is.
    for tail in ["", &"x".repeat(200_000)] {
        std::fs::write(&path, format!("{text}{tail}")).unwrap();
        run.score_log().unwrap().append(&[line(1, 3, 0.3)]).unwrap();
        assert_eq!(run.read_scores().unwrap(), [line(1, 1, 0.1), line(1, 2, 0.2), line(1, 3, 0.3)]);
    }

    std::fs::write(&path, text + "\n").unwrap();
    let error = run.read_scores().unwrap_err().to_string();
    assert!(error.contains("scores.jsonl, line 3"), "{error}");
}

/// In a folder that another user made, they may lead to any file of the user who trains there.
#[test]
fn no_link_is_written_through() {
    let folder = tempfile::tempdir().unwrap();
    let [path, precious, missing] =
        ["a", "precious", "missing"].map(|name| folder.path().join(name));
    std::fs::write(&precious, "no line of a log").unwrap();
    let (run, log) = RunDir::create(&path, &config("a", 0)).unwrap();
    drop(log);
    for name in
        ["endpoints.json.partial", "metrics.jsonl", "scores.jsonl", "failed", "judgments.json"]
    {
        std::fs::remove_file(path.join(name)).ok();
        symlink(&precious, path.join(name)).unwrap();
    }
    assert!(run.score_log().is_err() && run.metrics_log(0).is_err());
    run.write_json("endpoints.json", &1).unwrap();
    run.write_json("judgments.json", &1).unwrap();
    run.mark_failed(true).unwrap();
    run.remove_partial_files();
    assert_eq!(std::fs::read_to_string(precious).unwrap(), "no line of a log");
    assert_eq!(run.read_json::<u8>("judgments.json").unwrap(), 1);

    std::fs::remove_file(path.join("scores.jsonl")).unwrap();
    symlink(&missing, path.join("scores.jsonl")).unwrap();
    assert!(
        run.score_log().is_err() && !missing.exists(),
        "not even a lock makes the file that a link names"
    );
}

/// Snapshots of another run would be overwritten, and half files of other programs removed.
#[test]
fn no_folder_is_written_to_through_a_link() {
    let folder = tempfile::tempdir().unwrap();
    let [path, other] = ["a", "other"].map(|name| folder.path().join(name));
    let (run, _log) = RunDir::create(&path, &config("a", 0)).unwrap();
    std::fs::create_dir(&other).unwrap();
    std::fs::write(other.join("step_000000010.safetensors"), "precious").unwrap();
    std::fs::write(other.join("download.partial"), "precious").unwrap();
    std::fs::remove_dir(path.join("snapshots")).unwrap();
    symlink(&other, path.join("snapshots")).unwrap();
    run.remove_partial_files();
    assert!(run.write_snapshot(10, b"weights").is_err() && other.join("download.partial").exists());
    assert_eq!(
        std::fs::read_to_string(other.join("step_000000010.safetensors")).unwrap(),
        "precious"
    );
}

/// A pipe that no program writes to, and a file that seems to have more bytes than any memory.
#[test]
fn what_is_no_file_of_a_learners_is_not_waited_for_and_not_read() {
    let folder = tempfile::tempdir().unwrap();
    let (run, _log) = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap();
    run.write_checkpoint(&Checkpoint { step: 10, state: b"state".to_vec() }).unwrap();
    let checkpoint = run.path().join("checkpoints/step_000000020_0000000000000000.safetensors");
    for path in [&checkpoint, &run.snapshot_path(20)] {
        assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
    }
    File::create(run.snapshot_path(30)).unwrap().set_len(1 << 42).unwrap();
    symlink(run.snapshot_path(30), run.snapshot_path(40)).unwrap();
    assert_eq!(run.snapshots().unwrap(), [30], "a pipe and a link are no snapshots");
    let (tell, told) = channel();
    let reader = run.clone();
    std::thread::spawn(move || {
        let refused =
            [20, 30].map(|step| anyhow::Error::from(reader.read_snapshot(step).unwrap_err()));
        tell.send((refused.map(|error| format!("{error:#}")), reader.newest_checkpoint()))
    });
    let ([pipe, huge], newest) =
        told.recv_timeout(Duration::from_secs(60)).expect("it waits for a pipe");
    assert!(pipe.contains("a pipe") && huge.contains("too large"), "{pipe}, {huge}");
    assert_eq!(newest.unwrap().map(|checkpoint| checkpoint.step), Some(10));
}

/// A user who tidies up while a learner is at work.
#[test]
fn a_folder_of_snapshots_that_was_removed_is_made_again_and_a_run_that_was_removed_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let (run, _log) = RunDir::create(&path, &config("a", 0)).unwrap();
    std::fs::remove_dir_all(path.join("snapshots")).unwrap();
    assert_eq!(run.snapshots().unwrap(), [] as [u64; 0]);
    run.write_snapshot(10, b"weights").unwrap();
    assert_eq!(
        (run.snapshots().unwrap(), run.read_snapshot(10).unwrap()),
        (vec![10], b"weights".to_vec())
    );
    std::fs::remove_dir_all(&path).unwrap();
    let error = run.write_snapshot(20, b"weights").unwrap_err();
    assert!(matches!(&error, RunDirError::Gone(gone) if *gone == path), "{error}");
    assert!(!path.exists());
}
