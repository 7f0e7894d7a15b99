use quad_dataset::{ReadOptions, Transitions, environment, inspect};

use super::without_name;
use crate::shared;

/// A file of `cases`, and what its user is told in one problem, in this order; nothing if it is sound.
const CASES: &[(&str, &[&str])] = &[
    ("sound.hdf5", &[]),
    ("sound-d4rl.hdf5", &[]),
    ("lzf.hdf5", &[]),
    ("half-precision.hdf5", &[]),
    ("chunk-ends-at-rest.hdf5", &[]),
    ("chunk-ends-at-rest-padded.hdf5", &[]),
    ("constant-columns.hdf5", &[]),
    ("episode-terminals.h5", &[]),
    ("rewards-all-one.hdf5", &["all are alike", "good from bad"]),
    ("timeouts-one-row-late.hdf5", &["one row late"]),
    ("one-observation-near-a-million.hdf5", &["far from ±1"]),
    ("discount-as-done.hdf5", &["98", "a mask or a discount"]),
    ("frozen-observations.hdf5", &["does not change in 90"]),
    ("degrees-newtons.hdf5", &["--normalize rewards"]),
    ("done-at-time-limit.hdf5", &["140 of 200", "15 steps"]),
    ("timeouts-never-set.hdf5", &["(192 such rows)"]),
    ("transposed.hdf5", &["has shape [2, 1093]", "f[n][()].T"]),
    ("robomimic.hdf5", &["robomimic", "quad-convert"]),
    ("lerobot", &["LeRobot", "quad-convert"]),
    ("log.csv", &["CSV", "quad-convert"]),
];

#[test]
fn each_case_is_told_by_inspect_and_by_train() {
    for &(name, parts) in CASES {
        let path = shared(&format!("cases/{name}"));
        let Some(path) = path else { return };
        let options = ReadOptions::default();
        let told = match Transitions::read(&path, &options) {
            Err(error) => vec![format!("{error}; {}", error.hint())],
            Ok(transitions) => without_name(transitions.warnings(), &path),
        };
        if let Ok(inspection) = inspect(&[&path], None) {
            // A file that cannot be trained on is named.
            let prefix = format!("{}: ", path.display());
            let told = Vec::from_iter(told.iter().map(|told| told.replace(&prefix, "")));
            assert_eq!(inspection.problems, told, "{name}: one list");
        }
        let has = |problem: &String| parts.iter().all(|part| problem.contains(part));
        let is_sound = told.is_empty() && parts.is_empty();
        assert!(is_sound || told.iter().any(has), "{name}: {told:#?}");
    }
}

#[test]
fn recordings_of_others_are_sound() {
    for (file, name) in [
        ("data/hopper_medium_replay.hdf5", "hopper"),
        ("data/halfcheetah_medium_replay.hdf5", "halfcheetah"),
        ("data/walker2d_medium_replay.hdf5", "walker2d"),
        ("data/antmaze_umaze.hdf5", "antmaze-umaze"),
        ("data/antmaze_umaze_direct.hdf5", "antmaze-umaze"),
        ("data/antmaze_medium_play.hdf5", "antmaze-medium"),
        ("data/antmaze_medium_direct.hdf5", "antmaze-medium"),
        ("fixtures/hopper_fixture-v2.hdf5", "hopper"),
    ] {
        let Some(path) = shared(file) else { continue };
        for spec in [environment::find(name).ok(), None] {
            assert_eq!(inspect(&[&path], spec).unwrap().problems, [""; 0], "{file}");
        }
    }
}
