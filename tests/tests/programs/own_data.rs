//! A user's own log, of a robot that we do not simulate: it can be trained on.

use std::process::Command;

use ndarray::{Array1, Array2};
use quad_tests::process::binary;

/// Five numbers to observe and two to act by, in episodes of 50 steps, in the layout of docs/data.md.
fn write_log(path: &std::path::Path) {
    let rows = 1000;
    let file = hdf5::File::create(path).unwrap();
    let layout: hdf5::types::VarLenUnicode = "transitions".parse().unwrap();
    file.new_attr::<hdf5::types::VarLenUnicode>().create("layout").unwrap().write_scalar(&layout).unwrap();
    let observation =
        |shift: usize| Array2::from_shape_fn((rows, 5), |(i, j)| ((i + shift + 7 * j) as f64 / 9.0).sin());
    let actions = Array2::from_shape_fn((rows, 2), |(i, j)| ((i + 3 * j) as f64 / 5.0).cos());
    let rewards = Array1::from_shape_fn(rows, |i| (i % 50) as i64);
    let timeouts = Array1::from_shape_fn(rows, |i| u8::from(i % 50 == 49));
    file.new_dataset_builder().with_data(&observation(0)).create("observations").unwrap();
    file.new_dataset_builder().with_data(&observation(1)).create("next_observations").unwrap();
    file.new_dataset_builder().with_data(&actions).create("actions").unwrap();
    file.new_dataset_builder().with_data(&rewards).create("rewards").unwrap();
    file.new_dataset_builder().with_data(&Array1::from_elem(rows, false)).create("terminals").unwrap();
    file.new_dataset_builder().with_data(&timeouts).create("timeouts").unwrap();
}

#[test]
fn a_robot_that_we_do_not_know_is_learnt_from() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, run_dir) = (folder.path().join("robot.hdf5"), folder.path().join("robot"));
    write_log(&dataset);
    let mut command = Command::new(binary("learner"));
    command.args(["train", "--task", "own-data", "--set", "environment=my-robot", "--steps", "20"]);
    command.args(["--agent", "actor.hidden=[32]", "--agent", "critic.hidden=[32]", "--set", "batch_size=64"]);
    let output = command.arg("--dataset").arg(&dataset).arg("--run-dir").arg(&run_dir).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{text}");

    let config = std::fs::read_to_string(run_dir.join("config.toml")).unwrap();
    for line in ["environment = \"my-robot\"", "transitions = 1000", "episodes = 20", "mean_return = 1225.0"] {
        assert!(config.contains(line), "{line} is not in\n{config}");
    }
    assert!(!config.contains("mean_score"), "there are no reference returns:\n{config}");
    let snapshots = std::fs::read_dir(run_dir.join("snapshots")).unwrap().count();
    assert_eq!(snapshots, 1, "the last step's");
}
