//! Tests of a run folder.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use quad_protocol::encode;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::experience::tests::episode;
use super::{Checkpoint, ExistingRun, Log, RunDir, RunDirError};
use crate::config::resolve;
use crate::fixtures::{config, line};

/// A new run in a temporary folder.
fn new_run() -> (TempDir, PathBuf, RunDir, Log) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    let (run, log) = create(&path, 0).unwrap();
    (folder, path, run, log)
}

fn create(path: &Path, seed: u64) -> Result<(RunDir, Log), RunDirError> {
    RunDir::create(path, &config("a", seed))
}

#[test]
fn of_two_learners_that_begin_at_once_one_is_refused() {
    let (_folder, path, _run, log) = new_run();
    // The other is further, and has written its configuration, or not yet.
    assert!(matches!(create(&path, 1), Err(RunDirError::InUse(used)) if used == path));
    fs::remove_file(path.join("config.toml")).unwrap();
    assert!(matches!(create(&path, 1), Err(RunDirError::InUse(used)) if used == path));
    assert!(!RunDir::is_occupied(&path));
    drop(log);
    create(&path, 1).unwrap();
    assert!(matches!(create(&path, 1), Err(RunDirError::Occupied(_))));
}

#[test]
fn a_new_run_does_not_take_over_scores_of_unknown_origin() {
    let (_folder, path, _run, mut log) = new_run();
    log.append(&[line(1, 1, 0.1)]).unwrap();
    drop(log);
    fs::remove_file(path.join("config.toml")).unwrap();
    assert!(matches!(create(&path, 1), Err(RunDirError::Occupied(_))));
    fs::rename(path.join("scores.jsonl"), path.join("experience.log")).unwrap();
    assert!(matches!(create(&path, 1), Err(RunDirError::Occupied(_))));
}

#[test]
fn a_run_that_begins_or_resumes_is_no_longer_marked_as_failed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    fs::create_dir(&path).unwrap();
    RunDir::at(&path).mark_failed("").unwrap();
    let (run, log) = create(&path, 0).unwrap();
    assert_eq!(run.failure(), None);
    drop(log);
    run.mark_failed("the disk is full").unwrap();
    assert_eq!(run.failure().as_deref(), Some("the disk is full"));
    let existing = ExistingRun::open(&path, false).unwrap().unwrap();
    existing.resume(&config("a", 0).experiment).unwrap();
    assert_eq!(run.failure(), None);
}

#[test]
fn a_snapshot_that_is_not_the_one_that_played_online_is_damaged() {
    let folder = tempfile::tempdir().unwrap();
    let (path, mut config) = (folder.path().join("a"), config("a", 0));
    let online = "online = { steps = 4, warmup = 0, lag = 2 }".parse().unwrap();
    config.experiment.online = resolve("hopper-demo", &online).unwrap().online;
    config.experiment.steps = 10;
    let (run, log) = RunDir::create(&path, &config).unwrap();
    drop(log);
    run.write_checkpoint(&Checkpoint { step: 10, state: Vec::new() }).unwrap();
    let frame = encode(&episode(1)).unwrap();
    run.experience_log().unwrap().0.append([&*frame]).unwrap();
    for (file, is_good) in [(&b"weights"[..], true), (b"damaged", false)] {
        run.write_snapshot(10, file).unwrap();
        let existing = ExistingRun::open(&path, false).unwrap().unwrap();
        let (_, _, point) = existing.resume(&config.experiment).unwrap();
        assert_eq!(point.snapshots.contains_key(&10), is_good);
        assert_eq!(run.snapshots().unwrap(), if is_good { vec![10] } else { vec![] });
    }
}

#[test]
fn metrics_after_the_resumed_step_are_cut_off() {
    let (_folder, path, run, _log) = new_run();
    let row = |step: u64| json!({ "step": step, "seconds": step as f64 / 10.0, "eta": 1.0 });
    let (mut log, seconds) = run.metrics_log(0).unwrap();
    assert_eq!(seconds, 0.0);
    log.append(&[row(100), row(200), row(300)]).unwrap();
    drop(log);
    let (mut log, seconds) = run.metrics_log(250).unwrap();
    assert_eq!(seconds, 20.0);
    log.append(&[row(300)]).unwrap();
    let text = fs::read_to_string(path.join("metrics.jsonl")).unwrap();
    let parse = |line| serde_json::from_str::<Value>(line).unwrap()["step"].clone();
    assert_eq!(Vec::from_iter(text.lines().map(parse)), [100, 200, 300]);
}

/// The seeds of all scores.
fn seeds(run: &RunDir) -> Vec<u64> {
    run.read_scores().unwrap().into_iter().map(|line| line.seed).collect()
}

/// After a power cut, a later part of what was not synchronized may be there without an earlier.
#[test]
fn scores_survive_a_torn_append_is_dropped_and_damage_before_it_is_an_error() {
    let (_folder, path, run, mut log) = new_run();
    let path = path.join("scores.jsonl");
    log.append(&[line(1, 1, 0.1), line(1, 2, 0.2)]).unwrap();
    let first = fs::read(&path).unwrap().len();
    log.append(&[line(2, 3, 0.3), line(2, 4, 0.4), line(2, 5, 0.5)]).unwrap();
    drop(log);
    let whole = fs::read(&path).unwrap();
    let length = (whole.len() - first) / 3;
    let zeroed = |start: usize, end: usize| {
        let mut bytes = whole.clone();
        bytes[start..end].fill(0);
        fs::write(&path, &bytes).unwrap();
    };
    for (start, end, kept) in [
        (first, first + 9, 2),
        (first + length - 1, first + length, 2), // The end of a line.
        (first + length + 20, whole.len() - length, 3),
        (whole.len() - 1, whole.len(), 4),
        (first, whole.len(), 2),
    ] {
        zeroed(start, end);
        assert_eq!(run.read_scores().unwrap().len(), kept);
        run.score_log().unwrap().append(&[line(3, 6, 0.6)]).unwrap();
        assert_eq!(seeds(&run), Vec::from_iter((1..=kept as u64).chain([6])));
    }

    for tail in ["{\"step\":1,", &"x".repeat(200_000)] {
        fs::write(&path, [&whole, tail.as_bytes()].concat()).unwrap();
        assert_eq!(run.read_scores().unwrap()[4], line(2, 5, 0.5));
        run.score_log().unwrap().append(&[line(3, 6, 0.6)]).unwrap();
        assert_eq!(seeds(&run), [1, 2, 3, 4, 5, 6]);
    }

    zeroed(5, 9);
    drop(run.score_log().unwrap());
    assert_eq!(fs::read(&path).unwrap().len(), whole.len());
    let error = run.read_scores().unwrap_err().to_string();
    assert!(error.contains("scores.jsonl, line 1"), "{error}");
}

/// Each line of an older log was on the disk before the next append.
#[test]
fn damage_between_lines_without_a_position_is_an_error() {
    let (_folder, path, run, log) = new_run();
    drop(log);
    let text = |seed| serde_json::to_string(&line(1, seed, 0.1)).unwrap();
    let lines = [text(1), "{".to_owned(), text(2), String::new()].join("\n");
    fs::write(path.join("scores.jsonl"), lines).unwrap();
    let error = run.read_scores().unwrap_err().to_string();
    assert!(error.contains("scores.jsonl, line 2"), "{error}");
}

/// Another user who made the folder could link to any file of the user who trains there.
#[test]
fn does_not_write_through_links_to_files() {
    let (folder, path, run, log) = new_run();
    drop(log);
    let [precious, missing] = ["precious", "missing"].map(|name| folder.path().join(name));
    fs::write(&precious, "no line of a log").unwrap();
    let names =
        "endpoints.json.partial metrics.jsonl scores.jsonl experience.log failed judgments.json";
    for name in names.split(' ') {
        fs::remove_file(path.join(name)).ok();
        symlink(&precious, path.join(name)).unwrap();
    }
    assert!(run.score_log().is_err() && run.metrics_log(0).is_err());
    assert!(run.experience_log().is_err() && super::read_experience(&path).is_err());
    run.write_json("endpoints.json", &1).unwrap();
    run.write_json("judgments.json", &1).unwrap();
    run.mark_failed("").unwrap();
    run.remove_partial_files();
    assert_eq!(fs::read_to_string(precious).unwrap(), "no line of a log");
    assert_eq!(run.read_json::<u8>("judgments.json").unwrap(), 1);

    fs::remove_file(path.join("scores.jsonl")).unwrap();
    symlink(&missing, path.join("scores.jsonl")).unwrap();
    assert!(run.score_log().is_err() && !missing.exists());
}

/// Snapshots of another run would be overwritten, and partial files of other programs removed.
#[test]
fn does_not_write_through_links_to_folders() {
    let (folder, path, run, _log) = new_run();
    let other = folder.path().join("other");
    let [snapshot, partial] =
        ["step_000000010.safetensors", "download.partial"].map(|name| other.join(name));
    fs::create_dir(&other).unwrap();
    fs::write(&snapshot, "precious").unwrap();
    fs::write(&partial, "precious").unwrap();
    fs::remove_dir(path.join("snapshots")).unwrap();
    symlink(&other, path.join("snapshots")).unwrap();
    run.remove_partial_files();
    assert!(run.write_snapshot(10, b"weights").is_err() && partial.exists());
    assert_eq!(fs::read_to_string(snapshot).unwrap(), "precious");
}

#[test]
fn a_removed_snapshot_folder_is_made_again_and_a_removed_run_is_an_error() {
    let (_folder, path, run, _log) = new_run();
    fs::remove_dir_all(path.join("snapshots")).unwrap();
    assert_eq!(run.snapshots().unwrap(), [] as [u64; 0]);
    run.write_snapshot(10, b"weights").unwrap();
    assert_eq!(run.snapshots().unwrap(), [10]);
    assert_eq!(run.read_snapshot(10).unwrap(), b"weights");
    fs::remove_dir_all(&path).unwrap();
    let error = run.write_snapshot(20, b"weights").unwrap_err();
    assert!(matches!(&error, RunDirError::Gone(gone) if *gone == path), "{error}");
    assert!(!path.exists());
}
