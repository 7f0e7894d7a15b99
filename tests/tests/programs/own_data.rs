//! A user's own log, of a robot that we do not simulate: it can be trained on.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Command;

use ndarray::{Array1, Array2};
use quad_policy::{Header, Precision, load_policy};
use quad_protocol::Origin;
use quad_tests::process::{assert_refused, command, succeeds};

/// Writes observations of five numbers and actions of two, each up to `strength`, in episodes of 50
/// steps, in the layout of docs/data.md.
pub(super) fn write_log(path: &Path, strength: f64) {
    let rows = 1000;
    let file = hdf5::File::create(path).unwrap();
    let layout: hdf5::types::VarLenUnicode = "transitions".parse().unwrap();
    let attribute = file.new_attr::<hdf5::types::VarLenUnicode>().create("layout").unwrap();
    attribute.write_scalar(&layout).unwrap();
    let observation = |shift: usize| {
        Array2::from_shape_fn((rows, 5), |(i, j)| ((i + shift + 7 * j) as f64 / 9.0).sin())
    };
    let actions =
        Array2::from_shape_fn((rows, 2), |(i, j)| strength * ((i + 3 * j) as f64 / 5.0).cos());
    let rewards = Array1::from_shape_fn(rows, |i| (i % 50) as i64);
    let timeouts = Array1::from_shape_fn(rows, |i| u8::from(i % 50 == 49));
    let terminals = Array1::from_elem(rows, false);
    let array = || file.new_dataset_builder();
    array().with_data(&observation(0)).create("observations").unwrap();
    array().with_data(&observation(1)).create("next_observations").unwrap();
    array().with_data(&actions).create("actions").unwrap();
    array().with_data(&rewards).create("rewards").unwrap();
    array().with_data(&terminals).create("terminals").unwrap();
    array().with_data(&timeouts).create("timeouts").unwrap();
}

fn training(dataset: &str, run_dir: &str, flags: &str) -> Command {
    command(&format!(
        "learner train --task own-data --env my-robot --steps 20 --agent actor.hidden=[32] \
         --agent critic.hidden=[32] --set batch_size=64 --dataset {dataset} --run-dir {run_dir} \
         {flags}"
    ))
}

pub(super) fn train(dataset: &str, run_dir: &str, flags: &str) {
    let output = training(dataset, run_dir, flags).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn an_unknown_robot_is_learned_from() {
    let folder = tempfile::tempdir().unwrap();
    let run_dir = folder.path().join("robot");
    let dataset = folder.path().join("robot.hdf5");
    write_log(&dataset, 1.0);
    train(dataset.to_str().unwrap(), run_dir.to_str().unwrap(), "");

    let config = fs::read_to_string(run_dir.join("config.toml")).unwrap();
    for line in
        ["environment = \"my-robot\"", "transitions = 900", "episodes = 18", "mean_return = 1225.0"]
    {
        assert!(config.contains(line), "{line} is not in\n{config}");
    }
    assert!(!config.contains("mean_score"), "there are no reference returns:\n{config}");
    let config: toml::Table = config.parse().unwrap();
    assert_eq!(config["dataset"]["held_out"].as_array().unwrap().len(), 2, "of 20 episodes");
    let metrics = fs::read_to_string(run_dir.join("metrics.jsonl")).unwrap();
    let last: BTreeMap<String, f64> =
        serde_json::from_str(metrics.lines().last().unwrap()).unwrap();
    let ratio = last["held_out_bc_loss"] / last["bc_loss"];
    assert!((0.5..2.0).contains(&ratio), "alike episodes, hardly learned: {last:?}");
    let snapshots = fs::read_dir(run_dir.join("snapshots")).unwrap().count();
    assert_eq!(snapshots, 1, "the last step's");
}

#[test]
fn large_actions_are_learned_and_given_in_the_robots_units() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, run_dir) = (folder.path().join("robot.hdf5"), folder.path().join("robot"));
    write_log(&dataset, 30.0);
    let [data, run] = [&dataset, &run_dir].map(|path| path.to_str().unwrap());
    let refused = |flags: &str, sentence: &str, hint: &str| {
        assert_refused(&training(data, run, flags).output().unwrap(), sentence, hint);
    };
    refused("--normalize observations", "outside [-1, 1]", "--normalize actions");
    let inspected = command(&format!("learner datasets inspect {data}")).output().unwrap();
    assert_eq!(inspected.status.code(), Some(1), "it has a problem");
    let inspected = String::from_utf8(inspected.stdout).unwrap();
    assert!(inspected.contains("it can be trained on"), "{inspected}");
    assert!(inspected.contains("--normalize actions"), "{inspected}");

    train(data, run, "--normalize actions,observations");
    let file = fs::read(run_dir.join("snapshots/step_000000020.safetensors")).unwrap();
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

    let changed = r#"normalize: ["actions", "observations"] there, ["actions"] here"#;
    refused("--normalize actions", changed, "");
}

#[test]
fn of_a_runs_snapshots_the_last_is_judged_and_exported() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().display();
    write_log(&folder.path().join("robot.hdf5"), 1.0);
    train(&format!("{dir}/robot.hdf5"), &format!("{dir}/run"), "");
    // An earlier one, whatever is in it.
    let snapshot = |step: u64| format!("{dir}/run/snapshots/step_{step:09}.safetensors");
    fs::copy(snapshot(20), snapshot(10)).unwrap();
    let exported = succeeds(&format!("learner export {dir}/run --out {dir}/policy.safetensors"));
    assert!(exported.contains("run @ 20, "), "{exported}");
    let judged = succeeds(&format!("learner judge {dir}/run --json --steps 100"));
    let judged: serde_json::Value = serde_json::from_str(&judged).unwrap();
    assert_eq!(judged["policies"][0]["step"], 20);
}
