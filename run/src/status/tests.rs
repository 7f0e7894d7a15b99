//! Tests of what counts as complete.

use std::fs::remove_dir_all;

use super::*;
use crate::fixtures::{config, line};
use crate::folder::{Checkpoint, Log};

/// A run of 20 steps.
fn run(folder: &Path, eval_interval: u64) -> (RunDir, Log) {
    let mut config = config("a", 0);
    (config.experiment.steps, config.experiment.eval_interval) = (20, eval_interval);
    RunDir::create(&folder.join("a"), &config).unwrap()
}

fn state(run: &RunDir) -> State {
    State::from_report(&RunReport::scored(run.path()).unwrap()).unwrap()
}

#[test]
fn a_run_without_evaluations_is_complete_with_snapshot_and_checkpoint_of_the_last_step() {
    for (snapshot, checkpoint, expected) in
        [(10, 20, State::Begun(0)), (20, 10, State::Begun(0)), (20, 20, State::Complete)]
    {
        let folder = tempfile::tempdir().unwrap();
        let (run, _) = run(folder.path(), 0);
        run.write_snapshot(snapshot, b"weights").unwrap();
        run.write_checkpoint(&Checkpoint { step: checkpoint, state: vec![1] }).unwrap();
        assert_eq!(state(&run), expected, "{snapshot}, {checkpoint}");
        if expected == State::Complete {
            run.mark_failed("training diverged").unwrap();
            assert_eq!(state(&run), State::Failed(0));
            run.clear_failure().unwrap();
            // Checkpoints of a complete run may be deleted.
            remove_dir_all(run.path().join("checkpoints")).unwrap();
            assert_eq!(state(&run), State::Complete);
        }
    }
}

#[test]
fn scores_of_the_last_step_do_not_replace_its_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let (run, mut log) = run(folder.path(), 20);
    log.append(&[line(20, 1, 1.0), line(20, 2, 1.0)]).unwrap();
    assert_eq!(state(&run), State::Complete);
    run.write_checkpoint(&Checkpoint { step: 10, state: vec![1] }).unwrap();
    assert_eq!(state(&run), State::Begun(0));
}
