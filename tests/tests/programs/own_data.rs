//! A user's own log, of a robot that we do not simulate: it can be trained on.

use std::fs;
use std::path::Path;
use std::process::Command;

use ndarray::{Array1, Array2};
use quad_policy::{Header, Precision, load_policy};
use quad_protocol::Origin;
use quad_tests::process::{assert_refused, command, stdout};
use serde_json::Value;

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
    let action = |(i, j)| strength * ((i + 3 * j) as f64 / 5.0).cos();
    let actions = Array2::from_shape_fn((rows, 2), action);
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
    stdout(&training(dataset, run_dir, flags).output().unwrap());
}

#[test]
fn an_unknown_robot_is_learned_from() {
    let folder = tempfile::tempdir().unwrap();
    let run_dir = folder.path().join("robot");
    let dataset = folder.path().join("robot.hdf5");
    write_log(&dataset, 1.0);
    train(dataset.to_str().unwrap(), run_dir.to_str().unwrap(), "");

    let config = fs::read_to_string(run_dir.join("config.toml")).unwrap();
    let config: toml::Table = config.parse().unwrap();
    let data = &config["dataset"];
    assert_eq!(config["experiment"]["environment"].as_str(), Some("my-robot"));
    assert_eq!(data["transitions"].as_integer(), Some(900));
    assert_eq!(data["episodes"].as_integer(), Some(18));
    assert_eq!(data["mean_return"].as_float(), Some(1225.0));
    assert_eq!(data.get("mean_score"), None, "there are no reference returns");
    assert_eq!(data["held_out"].as_array().unwrap().len(), 2, "of 20 episodes");
    let metrics = fs::read_to_string(run_dir.join("metrics.jsonl")).unwrap();
    let last: Value = serde_json::from_str(metrics.lines().last().unwrap()).unwrap();
    let [held_out, trained] = ["held_out_bc_loss", "bc_loss"].map(|name| last[name].as_f64());
    let ratio = held_out.unwrap() / trained.unwrap();
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
    let refused = training(data, run, "--normalize actions").output().unwrap();
    assert_refused(&refused, changed, "--fresh");
}
