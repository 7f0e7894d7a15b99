//! Tests of what counts as complete.

use super::*;
use crate::fixtures::{config, line};
use crate::folder::Checkpoint;

/// A run of 20 steps without evaluations, after these steps.
fn run(folder: &Path, snapshot: u64, checkpoint: u64) -> RunDir {
    let mut config = config("a", 0);
    (config.experiment.steps, config.experiment.eval_interval) = (20, 0);
    let (run, _) = RunDir::create(&folder.join("a"), &config).unwrap();
    run.write_snapshot(snapshot, b"weights").unwrap();
    run.write_checkpoint(&Checkpoint { step: checkpoint, state: vec![1] }).unwrap();
    run
}

fn state(run: &RunDir) -> State {
    State::from_report(&RunReport::scored(run.path()).unwrap()).unwrap()
}

#[test]
fn a_run_without_evaluations_is_complete_with_snapshot_and_checkpoint_of_the_last_step() {
    for (snapshot, checkpoint, expected) in
        [(20, 20, State::Complete), (10, 20, State::Begun(0)), (20, 10, State::Begun(0))]
    {
        let folder = tempfile::tempdir().unwrap();
        let run = run(folder.path(), snapshot, checkpoint);
        assert_eq!(state(&run), expected, "{snapshot}, {checkpoint}");
    }
}

#[test]
fn a_run_that_failed_is_not_complete() {
    let folder = tempfile::tempdir().unwrap();
    let run = run(folder.path(), 20, 20);
    run.mark_failed("training diverged").unwrap();
    assert_eq!(state(&run), State::Failed(0));
    run.clear_failure().unwrap();
    assert_eq!(state(&run), State::Complete);
}

#[test]
fn all_checkpoints_of_a_complete_run_may_be_deleted() {
    let folder = tempfile::tempdir().unwrap();
    let run = run(folder.path(), 20, 20);
    std::fs::remove_dir_all(run.path().join("checkpoints")).unwrap();
    assert_eq!(state(&run), State::Complete);
}

#[test]
fn scores_of_the_last_step_do_not_replace_its_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = config("a", 0);
    (config.experiment.steps, config.experiment.eval_interval) = (20, 20);
    let (run, mut log) = RunDir::create(&folder.path().join("a"), &config).unwrap();
    log.append(&[line(20, 1, 1.0), line(20, 2, 1.0)]).unwrap();
    assert_eq!(state(&run), State::Complete);
    run.write_checkpoint(&Checkpoint { step: 10, state: vec![1] }).unwrap();
    assert_eq!(state(&run), State::Begun(0));
}
