use quad_dataset::{ReadOptions, Transitions, inspect};

use crate::shared;

/// A file of `cases`, and what its user is told in one problem, in this order; nothing if it is sound.
const CASES: [(&str, &[&str]); 20] = [
    ("sound.hdf5", &[]),
    ("sound-d4rl.hdf5", &[]),
    ("lzf.hdf5", &[]),
    ("half-precision.hdf5", &[]),
    ("chunk-ends-at-rest.hdf5", &[]),
    ("chunk-ends-at-rest-padded.hdf5", &[]),
    ("constant-columns.hdf5", &[]),
    ("episode-terminals.h5", &[]),
    ("rewards-all-one.hdf5", &["all are alike", "nothing distinguishes good from bad"]),
    ("timeouts-one-row-late.hdf5", &["one row late", "states jump"]),
    ("one-observation-near-a-million.hdf5", &["far from ±1", "--normalize observations"]),
    ("discount-as-done.hdf5", &["98", "a mask or a discount"]),
    ("frozen-observations.hdf5", &["does not change in 90", "the action does"]),
    ("degrees-newtons.hdf5", &["exp(β · advantage)", "--normalize rewards"]),
    ("done-at-time-limit.hdf5", &["140 of 200", "the longest length", "15 steps", "`timeouts`"]),
    ("timeouts-never-set.hdf5", &["(192 such rows)", "as after a reset", "timeouts missing"]),
    ("transposed.hdf5", &["has shape [2, 1093]", "f[n][()].T"]),
    ("robomimic.hdf5", &["robomimic", "quad-convert"]),
    ("lerobot", &["LeRobot", "quad-convert"]),
    ("log.csv", &["CSV", "quad-convert"]),
];

#[test]
fn each_case_is_told_by_inspect_and_by_train() {
    for (name, parts) in CASES {
        let Some(path) = shared(&format!("cases/{name}")) else { return };
        let options = ReadOptions::default();
        let told = match Transitions::read(&path, &options) {
            Err(error) => vec![format!("{error}; {}", error.hint())],
            Ok(transitions) => transitions.warnings().to_vec(),
        };
        if let Ok(inspection) = inspect(&path, None) {
            // A file that cannot be trained on is named.
            let prefix = format!("{}: ", path.display());
            let told = told.iter().map(|told| told.strip_prefix(&prefix).unwrap_or(told));
            assert_eq!(inspection.problems, Vec::from_iter(told), "{name}: one list");
        }
        let has = |problem: &String| parts.iter().all(|part| problem.contains(part));
        assert!(told.iter().any(has) || told.is_empty() && parts.is_empty(), "{name}: {told:#?}");
    }
}
