//! The environments against the real Gymnasium, which `gymnasium_reference.py` drives.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use quad_dataset::environment::find;
use quad_evaluator::environment::{make, mjcf};
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
        .current_dir(env!("CARGO_TARGET_TMPDIR")) // MuJoCo logs its warnings to a file there.
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

fn the_model_is_gymnasiums(name: &str) {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), mjcf(find(name).unwrap()).unwrap()).unwrap();
    let Some(model) = reference::<ModelComparison>(&["model", name, file.path().to_str().unwrap()]) else { return };
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

/// Replays Gymnasium's steps; gives the share of them that terminated.
fn steps_are_gymnasiums(name: &str) -> Option<f64> {
    let recording = reference::<Recording>(&["steps", name])?;
    assert!(recording.sequences.len() >= 1000);
    let mut environment = make(find(name).unwrap(), 0).unwrap();
    let (mut worst, mut steps, mut terminated) = (0.0_f64, 0, 0);
    for (number, sequence) in recording.sequences.iter().enumerate() {
        environment.set_state(&sequence.qpos, &sequence.qvel);
        for (place, expected) in sequence.steps.iter().enumerate() {
            let step = environment.step(&expected.action);
            let observation = environment.observation();
            assert_eq!(observation.len(), expected.observation.len());
            let errors = observation.iter().zip(&expected.observation).map(|(ours, theirs)| (ours - theirs).abs());
            let error = errors.fold((step.reward - expected.reward).abs(), f64::max);
            assert!(error <= TOLERANCE, "sequence {number}, step {place}: {error:e} apart");
            assert_eq!(step.terminated, expected.terminated, "sequence {number}, step {place}");
            worst = worst.max(error);
            steps += 1;
            terminated += usize::from(step.terminated);
        }
    }
    println!("{name}: {steps} steps, {terminated} of them terminated; the worst error is {worst:.1e}");
    Some(terminated as f64 / steps as f64)
}

#[test]
fn hopper_is_gymnasiums() {
    the_model_is_gymnasiums("hopper");
    let terminated = steps_are_gymnasiums("hopper");
    assert!(terminated.is_none_or(|share| (0.1..0.9).contains(&share)), "{terminated:?}");
}

#[test]
fn halfcheetah_is_gymnasiums() {
    the_model_is_gymnasiums("halfcheetah");
    let terminated = steps_are_gymnasiums("halfcheetah");
    assert!(terminated.is_none_or(|share| share == 0.0), "{terminated:?}");
}

#[test]
fn walker2d_is_gymnasiums() {
    the_model_is_gymnasiums("walker2d");
    let terminated = steps_are_gymnasiums("walker2d");
    assert!(terminated.is_none_or(|share| (0.1..0.9).contains(&share)), "{terminated:?}");
}
