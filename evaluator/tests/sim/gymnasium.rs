//! The environments against the real Gymnasium, which `gymnasium_reference.py` drives.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::Path;
use std::process::{Command, Stdio};

use quad_dataset::Simulator;
use quad_dataset::environment::{find, specs};
use quad_evaluator::sim::{make, mjcf};
use serde::Deserialize;
use serde::de::DeserializeOwned;

use crate::python::python;

const TOLERANCE: f64 = 1e-9;

/// The output of the script; `None` if Gymnasium is not installed and not required.
fn reference<T: DeserializeOwned>(arguments: &[&str]) -> Option<T> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = python("gymnasium, mujoco, ogbench")?;
    let mut command = Command::new(python);
    command.args(["-W", "ignore"]).args([folder.join("tests/gymnasium_reference.py")]);
    // MuJoCo logs its warnings to a file in the current directory.
    command.args(arguments).current_dir(env!("CARGO_TARGET_TMPDIR"));
    let output = command.stderr(Stdio::inherit()).output().unwrap();
    assert!(output.status.success(), "the script failed");
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

#[derive(Deserialize)]
struct ModelComparison {
    compared: usize,
    /// Names of the fields that differ, and in what.
    differ: BTreeMap<String, String>,
}

/// Compares a model of ours (MJCF) with Gymnasium's: only the fields named may differ.
fn assert_model(ours: &str, theirs: &str, may_differ: &[&str]) {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), ours).unwrap();
    let path = file.path().to_str().unwrap();
    let Some(ModelComparison { compared, differ }) = reference(&["model", theirs, path]) else {
        return;
    };
    assert!(compared > 1000, "only {compared} numbers were compared");
    assert!(differ.keys().eq(may_differ), "{differ:#?}");
}

/// Steps in a row from a random state.
#[derive(Deserialize)]
struct Sequence {
    qpos: Vec<f64>,
    qvel: Vec<f64>,
    goal: Vec<f64>,
    steps: Vec<RecordedStep>,
}

#[derive(Deserialize)]
struct RecordedStep {
    action: Vec<f32>,
    observation: Vec<f64>,
    reward: f64,
    terminated: bool,
}

/// Compares an environment with Gymnasium's: its model, and its steps, of which a share in
/// `terminated` terminates.
fn assert_gymnasiums(name: &str, terminated: RangeInclusive<f64>) {
    assert_model(&mjcf(find(name).unwrap()), name, &[]);
    assert_steps(name, terminated);
}

fn assert_steps(name: &str, terminated: RangeInclusive<f64>) {
    let recording = reference::<BTreeMap<String, Vec<Sequence>>>(&["steps", name]);
    let Some(sequences) = recording.map(|mut recording| recording.remove("sequences").unwrap())
    else {
        return;
    };
    assert!(sequences.len() >= 1000);
    let mut environment = make(find(name).unwrap(), 0).unwrap();
    let (mut worst, mut steps, mut ended) = (0.0_f64, 0, 0);
    for (number, sequence) in sequences.iter().enumerate() {
        environment.set_goal(&sequence.goal);
        environment.set_state(&sequence.qpos, &sequence.qvel);
        for (place, expected) in sequence.steps.iter().enumerate() {
            let step = environment.step(&expected.action);
            let observation = environment.observation();
            assert_eq!(observation.len(), expected.observation.len());
            let pairs = observation.iter().zip(&expected.observation);
            let errors = pairs.map(|(ours, theirs)| (ours - theirs).abs());
            let error = errors.fold((step.reward - expected.reward).abs(), f64::max);
            let place = format!("sequence {number}, step {place}");
            assert!(error <= TOLERANCE, "{place}: {error:e} apart");
            assert_eq!(step.terminated, expected.terminated, "{place}");
            worst = worst.max(error);
            steps += 1;
            ended += usize::from(step.terminated);
        }
    }
    println!("{name}: {ended} of {steps} steps terminated; the worst error is {worst:.1e}");
    let share = ended as f64 / steps as f64;
    assert!(terminated.contains(&share), "{share} of the steps terminated");
}

#[test]
fn planar_robots_are_gymnasiums() {
    for spec in specs().iter().filter(|spec| !spec.gymnasium.is_empty()) {
        let ends = matches!(&spec.simulator, Simulator::Planar(robot) if robot.healthy.is_some());
        assert_gymnasiums(&spec.name, if ends { 0.1..=0.9 } else { 0.0..=0.0 });
    }
}

#[test]
fn the_ant_is_gymnasiums_but_for_motors_contacts_and_time_step() {
    let differ =
        ["actuator_acc0", "actuator_ctrlrange", "actuator_gear", "geom_solimp", "opt.timestep"];
    assert_model(include_str!("../../assets/ant.xml"), "ant", &differ);
}

#[test]
fn the_ant_in_a_maze_is_gymnasiums_among_walls() {
    for name in ["antmaze-umaze", "antmaze-medium", "antmaze-large"] {
        assert_gymnasiums(name, 0.1..=0.9);
    }
}

#[test]
fn the_ant_and_the_ball_in_a_maze_of_ogbench_move_as_there() {
    for (robot, maze) in ["antmaze", "pointmaze"]
        .iter()
        .flat_map(|robot| ["medium", "large", "giant"].map(|maze| (robot, maze)))
    {
        // Their models differ in what nothing depends on: the unit of controls, a mark at the goal,
        // where the floor's center is.
        assert_steps(&format!("{robot}-{maze}-singletask-v0"), 0.1..=0.9);
    }
}
