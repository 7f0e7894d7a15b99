//! What `learner verify` finds in a folder.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;

use quad_learner::config::{DatasetInfo, RunConfig, RunInfo, resolve};
use quad_learner::run_dir::{RunDir, ScoreLine};
use quad_learner::verify::{compare, verify};
use quad_protocol::{Hash, episode_seeds};

/// Evaluations of steps 10 and 15, three episodes each.
fn config() -> RunConfig {
    let changes = toml::toml! { steps = 15 eval_interval = 10 episodes = 3 seed = 4 };
    RunConfig {
        run: RunInfo {
            name: "a".into(),
            incarnation: 1,
            preset: "hopper-demo".into(),
            version: "0".into(),
            device: Default::default(),
        },
        dataset: DatasetInfo {
            path: "d.hdf5".into(),
            sha256: Some("00".into()),
            transitions: 1,
            episodes: 1,
            min_return: 0.0,
            mean_return: 0.0,
            max_return: 0.0,
            mean_score: None,
        },
        experiment: resolve("hopper-demo", &changes).unwrap(),
    }
}

/// A run that is as it should be, but for what is done to its lines.
fn write(path: &Path, change: impl FnOnce(&mut Vec<ScoreLine>)) {
    let (run, mut log) = RunDir::create(path, &config()).unwrap();
    let mut lines = Vec::new();
    for step in [10, 15] {
        let tensors = [step as u8; 100];
        run.write_snapshot(step, &tensors).unwrap();
        lines.extend(episode_seeds(4, step, 3).into_iter().map(|seed| ScoreLine {
            step,
            seed,
            episode_return: seed as f64,
            length: 5,
            score: 1.0,
            weights: Hash::of(&tensors).to_string(),
            precision: "f32".into(),
            evaluator: "e".into(),
        }));
    }
    change(&mut lines);
    log.append(&lines).unwrap();
}

#[test]
fn each_broken_promise_is_found() {
    type Change = fn(&mut Vec<ScoreLine>);
    let changes: [(&str, Change); 6] = [
        ("", |_| ()),
        ("without a score", |lines| drop(lines.pop())),
        ("scored twice", |lines| lines.push(lines[0].clone())),
        ("no episode of this run", |lines| lines.push(ScoreLine { seed: 1, ..lines[0].clone() })),
        ("scored with other weights than are on disk", |lines| lines[2].weights = lines[3].weights.clone()),
        ("scored, but the snapshot is gone", |lines| lines.push(ScoreLine { step: 12, ..lines[0].clone() })),
    ];
    for (expected, change) in changes {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        write(&path, change);
        let found = verify(&path).unwrap();
        assert_eq!(found.all_held(), expected.is_empty(), "{found}");
        assert!(expected.is_empty() || found.wrong.contains_key(expected), "{expected}: {found}");
        assert_eq!(found.expected, 6);
    }
}

#[test]
fn two_runs_are_compared_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let paths = ["a", "b", "c", "d", "e", "f"].map(|name| folder.path().join(name));
    write(&paths[0], |_| ());
    write(&paths[1], |lines| lines[0].episode_return = lines[0].episode_return.next_up());
    write(&paths[2], |lines| lines.truncate(2));
    write(&paths[3], |lines| lines[5].weights = "00".into());
    write(&paths[4], |lines| lines.clear());
    write(&paths[5], |lines| lines[0].precision = "f32-avx2".into());
    let found = |other: usize| compare(&paths[0], &paths[other]).unwrap();
    assert!(found(0).all_held() && found(0).found == 6);
    let expected = [
        (1, 5, "scores that differ"),
        (2, 2, "not scored there"),
        (3, 5, "weights that differ"),
        (4, 0, "not scored there"),
        (5, 5, "not to be compared, because they were computed by other instructions"),
    ];
    for (other, same, wrong) in expected {
        let found = found(other);
        assert!(found.found == same && found.wrong.keys().eq([&wrong]), "{other}: {found}");
    }
    // What only the other one has does not matter.
    assert!(compare(&paths[2], &paths[0]).unwrap().all_held());
}
