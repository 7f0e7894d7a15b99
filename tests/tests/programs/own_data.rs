//! A user's own log, of a robot that we do not simulate: it can be trained on.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output};

use ndarray::{Array1, Array2};
use quad_policy::{Header, Precision, load_policy};
use quad_protocol::Origin;
use quad_tests::process::binary;

/// Five numbers to observe and two to act by, each up to `strength`, in episodes of 50 steps, in
/// the layout of docs/data.md.
pub(super) fn write_log(path: &Path, strength: f64) {
    let rows = 1000;
    let file = hdf5::File::create(path).unwrap();
    let layout: hdf5::types::VarLenUnicode = "transitions".parse().unwrap();
    file.new_attr::<hdf5::types::VarLenUnicode>()
        .create("layout")
        .unwrap()
        .write_scalar(&layout)
        .unwrap();
    let observation = |shift: usize| {
        Array2::from_shape_fn((rows, 5), |(i, j)| ((i + shift + 7 * j) as f64 / 9.0).sin())
    };
    let actions =
        Array2::from_shape_fn((rows, 2), |(i, j)| strength * ((i + 3 * j) as f64 / 5.0).cos());
    let rewards = Array1::from_shape_fn(rows, |i| (i % 50) as i64);
    let timeouts = Array1::from_shape_fn(rows, |i| u8::from(i % 50 == 49));
    file.new_dataset_builder().with_data(&observation(0)).create("observations").unwrap();
    file.new_dataset_builder().with_data(&observation(1)).create("next_observations").unwrap();
    file.new_dataset_builder().with_data(&actions).create("actions").unwrap();
    file.new_dataset_builder().with_data(&rewards).create("rewards").unwrap();
    file.new_dataset_builder()
        .with_data(&Array1::from_elem(rows, false))
        .create("terminals")
        .unwrap();
    file.new_dataset_builder().with_data(&timeouts).create("timeouts").unwrap();
}

pub(super) fn train(dataset: &Path, run_dir: &Path, flags: &[&str]) -> Output {
    let mut command = Command::new(binary("learner"));
    command.args(["train", "--task", "own-data", "--env", "my-robot", "--steps", "20"]);
    command.args([
        "--agent",
        "actor.hidden=[32]",
        "--agent",
        "critic.hidden=[32]",
        "--set",
        "batch_size=64",
    ]);
    command
        .arg("--dataset")
        .arg(dataset)
        .arg("--run-dir")
        .arg(run_dir)
        .args(flags)
        .output()
        .unwrap()
}

/// What a command writes for people, which must end so.
pub(super) fn said(output: &Output, code: i32) -> String {
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "{text}");
    text
}

#[test]
fn a_robot_that_we_do_not_know_is_learned_from() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, run_dir) = (folder.path().join("robot.hdf5"), folder.path().join("robot"));
    write_log(&dataset, 1.0);
    said(&train(&dataset, &run_dir, &[]), 0);

    let config = std::fs::read_to_string(run_dir.join("config.toml")).unwrap();
    for line in
        ["environment = \"my-robot\"", "transitions = 900", "episodes = 18", "mean_return = 1225.0"]
    {
        assert!(config.contains(line), "{line} is not in\n{config}");
    }
    assert!(!config.contains("mean_score"), "there are no reference returns:\n{config}");
    let held_out = config.split_once("held_out = [").unwrap().1.split_once(']').unwrap().0;
    assert_eq!(
        held_out.split(',').filter(|number| !number.trim().is_empty()).count(),
        2,
        "of 20 episodes: {config}"
    );
    let metrics = std::fs::read_to_string(run_dir.join("metrics.jsonl")).unwrap();
    let last: BTreeMap<String, f64> =
        serde_json::from_str(metrics.lines().last().unwrap()).unwrap();
    let ratio = last["held_out_bc_loss"] / last["bc_loss"];
    assert!((0.5..2.0).contains(&ratio), "alike episodes, hardly learned: {last:?}");
    let snapshots = std::fs::read_dir(run_dir.join("snapshots")).unwrap().count();
    assert_eq!(snapshots, 1, "the last step's");
}

#[test]
fn a_robot_whose_actions_are_large_is_learned_from_in_its_own_units() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, run_dir) = (folder.path().join("robot.hdf5"), folder.path().join("robot"));
    write_log(&dataset, 30.0);
    let refused = said(&train(&dataset, &run_dir, &["--scale", "states"]), 1);
    assert!(
        refused.contains("outside [-1, 1]") && refused.contains("--scale actions"),
        "{refused}"
    );
    let inspected = Command::new(binary("learner"))
        .args(["datasets", "inspect"])
        .arg(&dataset)
        .output()
        .unwrap();
    assert_eq!(inspected.status.code(), Some(1), "it has a problem");
    let inspected = String::from_utf8(inspected.stdout).unwrap();
    assert!(
        inspected.contains("it can be trained on") && inspected.contains("--scale actions"),
        "{inspected}"
    );

    said(&train(&dataset, &run_dir, &["--scale", "actions,states"]), 0);
    let file = std::fs::read(run_dir.join("snapshots/step_000000020.safetensors")).unwrap();
    let scaling = Header::<Origin>::read(&file).unwrap().scaling.unwrap();
    let (of_actions, of_states) = (scaling.actions.unwrap(), scaling.observations.unwrap());
    assert!(of_actions.scale.iter().all(|scale| (29.9..=30.0).contains(scale)), "{of_actions:?}");
    // A sine's deviation is the square root of a half.
    assert!(of_states.scale.iter().all(|scale| (0.7..0.72).contains(scale)), "{of_states:?}");
    let policy = load_policy(&file, Precision::F32).unwrap();
    let observations: Vec<f32> = (0..500).map(|i| (i as f32 / 9.0).sin()).collect();
    let mut states: Vec<_> = (0..100).map(|seed| policy.begin(seed)).collect();
    let mut actions = vec![0.0; 200];
    policy.act(&observations, &mut states, &mut actions).unwrap();
    assert!(actions.iter().all(|action| action.abs() <= 30.001), "{actions:?}");
    assert!(actions.iter().any(|action| action.abs() > 5.0), "in the robot's units: {actions:?}");

    let other = said(&train(&dataset, &run_dir, &["--scale", "actions"]), 1);
    assert!(other.contains(r#"scale: ["actions", "states"] there, ["actions"] here"#), "{other}");
}
