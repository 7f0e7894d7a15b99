//! What `learner verify` finds in a folder.

use std::fs;
use std::path::Path;

use quad_protocol::{Hash, episode_seeds};
use serde_json::{Value, json};

use crate::learner;
use crate::run::Run;

/// A run that is as it should be, but for what is done to its lines: evaluations of steps 10 and
/// 15, three episodes each.
fn write(path: &Path, change: impl FnOnce(&mut Vec<Value>)) {
    let [steps, eval_interval, episodes] = [15, 10, 3].map(toml::Value::from);
    let mut run = Run::new("hopper-demo", 4).set(&[
        ("experiment.steps", steps),
        ("experiment.eval_interval", eval_interval),
        ("experiment.episodes", episodes),
    ]);
    for step in [10, 15] {
        for seed in episode_seeds(4, step, 3) {
            run.score(step, seed, 1.5, &Hash::of(&[step as u8; 100]).to_string());
        }
    }
    change(&mut run.scores);
    run.write(path);
    for step in [10, 15] {
        fs::write(path.join(format!("snapshots/step_{step:09}.safetensors")), [step as u8; 100])
            .unwrap();
    }
}

/// A copy of the first line, with one value changed.
fn again(lines: &mut Vec<Value>, key: &str, value: Value) {
    let mut line = lines[0].clone();
    line[key] = value;
    lines.push(line);
}

/// What it prints. The exit code is 0 only if everything held.
fn verify(arguments: &[&str], holds: bool) -> String {
    let output = learner(&[&["verify"], arguments].concat());
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(i32::from(!holds)), "{text}");
    text
}

#[test]
fn each_broken_promise_is_found() {
    type Change = fn(&mut Vec<Value>);
    let changes: [(&str, Change); 6] = [
        ("6 of 6 episodes are scored", |_| ()),
        ("without a score (1)", |lines| drop(lines.pop())),
        ("scored twice (1)", |lines| lines.push(lines[0].clone())),
        ("no episode of this run (1)", |lines| again(lines, "seed", json!(1))),
        ("scored with other weights than are on disk (1)", |lines| {
            lines[2]["weights"] = lines[3]["weights"].clone()
        }),
        ("scored, but the snapshot is gone (1)", |lines| again(lines, "step", json!(12))),
    ];
    let folder = tempfile::tempdir().unwrap();
    for (index, (expected, change)) in changes.into_iter().enumerate() {
        write(folder.path(), change);
        let found = verify(&[folder.path().to_str().unwrap()], index == 0);
        assert!(found.contains(expected), "{expected}: {found}");
    }
}

#[test]
fn two_runs_are_compared_bit_for_bit() {
    type Change = fn(&mut Vec<Value>);
    let changes: [(Change, usize, &str); 6] = [
        (|_| (), 6, ""),
        (|lines| lines[0]["return"] = json!(15f64.next_up()), 5, "scores that differ (1)"),
        (|lines| lines.truncate(2), 2, "not scored there (4)"),
        (|lines| lines[5]["weights"] = json!("00"), 5, "weights that differ (1)"),
        (|lines| lines.clear(), 0, "not scored there (6)"),
        (
            |lines| lines[0]["precision"] = json!("bf16-amx"),
            5,
            "not comparable, because the evaluators computed in another precision or by other instructions (1)",
        ),
    ];
    let folder = tempfile::tempdir().unwrap();
    let [ours, theirs] = ["a", "b"].map(|name| folder.path().join(name));
    write(&ours, |_| ());
    for (change, same, wrong) in changes {
        write(&theirs, change);
        let found = verify(
            &[ours.to_str().unwrap(), "--same-as", theirs.to_str().unwrap()],
            wrong.is_empty(),
        );
        assert!(
            found.contains(&format!("{same} of 6 episodes are compared")) && found.contains(wrong),
            "{found}"
        );
        assert!(
            !wrong.contains("precision") || found.contains("(f32-avx512 here, bf16-amx there)"),
            "{found}"
        );
    }
}

/// As with `--eval-interval 0`.
#[test]
fn runs_without_evaluations_are_compared_by_their_snapshots() {
    let folder = tempfile::tempdir().unwrap();
    let [ours, theirs] = ["a", "b"].map(|name| folder.path().join(name));
    for path in [&ours, &theirs] {
        let mut run = Run::new("hopper-demo", 4).set(&[("experiment.eval_interval", 0.into())]);
        run.scores.clear();
        run.write(path);
        fs::write(path.join("snapshots/step_000000015.safetensors"), [7; 100]).unwrap();
    }
    let compare =
        |holds| verify(&[ours.to_str().unwrap(), "--same-as", theirs.to_str().unwrap()], holds);
    assert!(compare(true).contains("1 of 1 snapshots are compared"));
    let snapshot = theirs.join("snapshots/step_000000015.safetensors");
    let mut flipped = [7; 100];
    flipped[50] ^= 1;
    fs::write(&snapshot, flipped).unwrap();
    let found = compare(false);
    assert!(
        found.contains("0 of 1 snapshots are compared\nsnapshots that differ (1): step 15"),
        "{found}"
    );
    fs::remove_file(&snapshot).unwrap();
    assert!(compare(false).contains("snapshots that are not there (1): step 15"));
    fs::remove_file(ours.join("snapshots/step_000000015.safetensors")).unwrap();
    assert!(compare(false).contains("nothing to compare"), "no success");
}
