//! Hopper against the real Gymnasium, which `gymnasium_reference.py` drives.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use quad_dataset::environment::find;
use quad_evaluator::environment::make;
use serde::Deserialize;
use serde::de::DeserializeOwned;

const TOLERANCE: f64 = 1e-9;

/// What the script prints, or nothing where Gymnasium is not installed and need not be.
fn reference<T: DeserializeOwned>(arguments: &[&str]) -> Option<T> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = std::env::var_os("QUAD_PYTHON").map_or(folder.join("../.deps/venv/bin/python"), PathBuf::from);
    let has_gymnasium = Command::new(&python)
        .args(["-c", "import gymnasium, mujoco"])
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success());
    if !has_gymnasium {
        let required = std::env::var_os("QUAD_REQUIRE_PEERS").is_some_and(|value| value == "1");
        assert!(!required, "{} has no gymnasium; deploy/setup.sh --tests installs it", python.display());
        println!("skipped, because {} has no gymnasium; deploy/setup.sh --tests installs it", python.display());
        return None;
    }
    let output = Command::new(python)
        .args(["-W", "ignore"])
        .arg(folder.join("tests/gymnasium_reference.py"))
        .args(arguments)
        .stderr(Stdio::inherit())
        .output()
        .unwrap();
    assert!(output.status.success(), "the script failed");
    Some(serde_json::from_slice(&output.stdout).unwrap())
}

#[derive(Deserialize)]
struct ModelComparison {
    compared: usize,
    differ: Vec<String>,
}

#[test]
fn the_model_is_gymnasiums_number_by_number() {
    let mjcf = concat!(env!("CARGO_MANIFEST_DIR"), "/assets/hopper.xml");
    let Some(model) = reference::<ModelComparison>(&["model", mjcf]) else { return };
    assert!(model.compared > 1000, "only {} numbers were compared", model.compared);
    assert!(model.differ.is_empty(), "{:#?}", model.differ);
}

#[derive(Deserialize)]
struct Recording {
    sequences: Vec<Sequence>,
}

/// Steps in a row from a random state.
#[derive(Deserialize)]
struct Sequence {
    qpos: Vec<f64>,
    qvel: Vec<f64>,
    steps: Vec<RecordedStep>,
}

#[derive(Deserialize)]
struct RecordedStep {
    action: Vec<f32>,
    observation: Vec<f64>,
    reward: f64,
    terminated: bool,
}

#[test]
fn steps_from_random_states_are_gymnasiums() {
    let Some(recording) = reference::<Recording>(&["steps"]) else { return };
    assert!(recording.sequences.len() >= 1000);
    let mut hopper = make(find("hopper").unwrap(), 0).unwrap();
    let (mut worst, mut steps, mut terminated) = (0.0_f64, 0, 0);
    for (number, sequence) in recording.sequences.iter().enumerate() {
        hopper.set_state(&sequence.qpos, &sequence.qvel);
        for (place, expected) in sequence.steps.iter().enumerate() {
            let step = hopper.step(&expected.action);
            let observation = hopper.observation();
            let errors = observation.iter().zip(&expected.observation).map(|(ours, theirs)| (ours - theirs).abs());
            let error = errors.fold((step.reward - expected.reward).abs(), f64::max);
            assert!(error <= TOLERANCE, "sequence {number}, step {place}: {error:e} apart");
            assert_eq!(step.terminated, expected.terminated, "sequence {number}, step {place}");
            worst = worst.max(error);
            steps += 1;
            terminated += usize::from(step.terminated);
        }
    }
    assert!(terminated > steps / 10 && terminated < steps * 9 / 10, "{terminated} of {steps} steps terminated");
    println!("{steps} steps, {terminated} of them terminated; the worst error is {worst:.1e}");
}
