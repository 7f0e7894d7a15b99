//! A user's own log, of a robot that we do not simulate: policies learn from it, are judged by it,
//! and go to the robot.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Output;

use ndarray::{Array1, Array2};
use quad_policy::{Header, Precision, load_policy};
use quad_protocol::Origin;
use quad_tests::process::{assert_refused, command, stdout, succeeds};
use serde_json::Value;

/// Writes observations of five numbers and actions of two, each up to `strength`, in episodes of 50
/// steps, in the layout of docs/data.md.
pub fn write_log(path: &Path, strength: f64) {
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

pub fn train(dataset: &str, run_dir: &str, flags: &str) -> Output {
    let mut train = command(&format!(
        "learner train --task own-data --env my-robot --steps 20 --agent actor.hidden=[32] \
         --agent critic.hidden=[32] --set batch_size=64 --dataset {dataset} --run-dir {run_dir} \
         {flags}"
    ));
    train.output().unwrap()
}

/// Two short runs on the log of a robot, which hold out two episodes of it.
fn runs(folder: &Path) -> [PathBuf; 2] {
    let data = folder.join("robot.hdf5");
    write_log(&data, 1.0);
    [("quad", "chunk=2"), ("iql", "value.hidden=[32]")].map(|(name, value)| {
        let run = folder.join("runs").join(name);
        let flags = format!("--algorithm {name} --agent {value}");
        stdout(&train(data.to_str().unwrap(), run.to_str().unwrap(), &flags));
        run
    })
}

/// The judgment, and the log.
fn judge(paths: &[&Path], flags: &str) -> (Value, String) {
    let paths = Vec::from_iter(paths.iter().map(|path| path.to_str().unwrap())).join(" ");
    let output = command(&format!("learner judge {paths} --json {flags}")).output().unwrap();
    let log = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{log}");
    (serde_json::from_slice(&output.stdout).unwrap(), log)
}

#[test]
fn an_unknown_robot_is_learned_from_and_its_exported_policy_acts_alike() {
    let scratch = tempfile::tempdir().unwrap();
    let [quad, _] = runs(scratch.path());
    let config = fs::read_to_string(quad.join("config.toml")).unwrap();
    let config: toml::Table = config.parse().unwrap();
    let data = &config["dataset"];
    assert_eq!(config["experiment"]["environment"].as_str(), Some("my-robot"));
    let counts = ["transitions", "episodes"].map(|key| data[key].as_integer());
    assert_eq!(counts, [Some(900), Some(18)]);
    assert_eq!(data["mean_return"].as_float(), Some(1225.0));
    assert_eq!(data.get("mean_score"), None, "there are no reference returns");
    assert_eq!(data["held_out"].as_array().unwrap().len(), 2, "of 20 episodes");
    let (run, out) = (quad.display(), scratch.path().join("policy.safetensors"));
    succeeds(&format!("learner export {run} --out {} --step 20 --license CC0", out.display()));
    let [file, snapshot] = [&out, &quad.join("snapshots/step_000000020.safetensors")]
        .map(|path| fs::read(path).unwrap());
    let [header, original] = [&file, &snapshot].map(|file| Header::<Origin>::read(file).unwrap());
    assert_eq!((&header.policy, &header.origin), (&original.policy, &original.origin));
    let about = &header.about;
    assert_eq!((&about["algorithm"], &about["data"]["license"]), (&"quad".into(), &"CC0".into()));
    assert_eq!(about["data"]["held_out"].as_array().unwrap().len(), 2);
    let act = |file: &[u8]| {
        let (policy, mut actions) = (load_policy(file, Precision::F32).unwrap(), vec![0.0; 2]);
        policy.act(&[0.1, 0.2, 0.3, 0.4, 0.5], &mut [policy.begin(7)], &mut actions).unwrap();
        actions
    };
    assert_eq!(act(&file), act(&snapshot));
}

#[test]
fn large_actions_are_learned_and_given_in_the_robots_units() {
    let folder = tempfile::tempdir().unwrap();
    let (dataset, run_dir) = (folder.path().join("robot.hdf5"), folder.path().join("robot"));
    write_log(&dataset, 30.0);
    let [data, run] = [&dataset, &run_dir].map(|path| path.to_str().unwrap());
    stdout(&train(data, run, "--normalize actions,observations"));
    let file = fs::read(run_dir.join("snapshots/step_000000020.safetensors")).unwrap();
    let scaling = Header::<Origin>::read(&file).unwrap().scaling.unwrap();
    let [actions, states] = [scaling.actions.unwrap(), scaling.observations.unwrap()];
    assert!(actions.scale.iter().all(|scale| (29.9..=30.0).contains(scale)), "{actions:?}");
    // A sine's deviation is the square root of a half.
    assert!(states.scale.iter().all(|scale| (0.7..0.72).contains(scale)), "{states:?}");
    let policy = load_policy(&file, Precision::F32).unwrap();
    let largest = (0..100).map(|seed| {
        let (mut state, mut actions) = ([policy.begin(seed)], [0.0; 2]);
        policy.act(&[0.5; 5], &mut state, &mut actions).unwrap();
        actions[0].abs().max(actions[1].abs())
    });
    let largest = largest.fold(0.0, f32::max);
    assert!((5.0..=30.001).contains(&largest), "in the robot's units: {largest}");

    let changed = r#"normalize: ["actions", "observations"] there, ["actions"] here"#;
    assert_refused(&train(data, run, "--normalize actions"), changed, "--fresh");
}

#[test]
fn policies_are_judged_by_the_data_alone() {
    let scratch = tempfile::tempdir().unwrap();
    let [quad, iql] = runs(scratch.path());
    let both = scratch.path().join("runs");
    let short = "--steps 200";

    let (judgment, log) = judge(&[&both], short);
    assert!(log.contains("is judged, in"), "{log}");
    let policies = judgment["policies"].as_array().unwrap();
    assert_eq!(policies.len(), 2);
    for policy in policies {
        assert_eq!(policy["estimate"]["values"].as_array().unwrap().len(), 2, "two seeds");
        assert_eq!((&policy["unseen"], &policy["step"]), (&true.into(), &20.into()));
        assert!((0.1..3.0).contains(&policy["distance"].as_f64().unwrap()), "{policy}");
    }
    // The episodes have rewards 0, 1, …, 48 and are truncated there.
    let exact: f64 = (0..49).map(|t| 0.99_f64.powi(t) * f64::from(t)).sum();
    let recorded = judgment["recorded"].as_f64().unwrap();
    assert!((0.5 * exact..2.0 * exact).contains(&recorded), "{recorded}, of data {exact}");

    // A policy that is named twice counts once, and nothing is computed twice.
    let snapshot = quad.join("snapshots/step_000000020.safetensors");
    let (again, log) = judge(&[&quad, &snapshot, &both], short);
    assert!(!log.contains("is judged"), "{log}");
    assert_eq!(again["policies"], judgment["policies"]);
    // Beside others each has the estimate that it has alone.
    let (alone, _) = judge(&[&iql], short);
    let estimates = Vec::from_iter(policies.iter().map(|policy| &policy["estimate"]));
    assert!(estimates.contains(&&alone["policies"][0]["estimate"]));
    let [data, moved] = ["robot.hdf5", "moved.hdf5"].map(|name| scratch.path().join(name));
    fs::rename(&data, &moved).unwrap();
    let (here, _) = judge(&[&iql], &format!("--steps 100 --dataset {}", moved.display()));
    assert_eq!(here["conditions"]["dataset"], judgment["conditions"]["dataset"]);
}
