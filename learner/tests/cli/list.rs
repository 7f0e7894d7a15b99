//! `learner list`: what is where, and how far it is.

use std::fs::{self, File};
use std::path::Path;

use serde_json::{Value, json};

use crate::printed;
use crate::run::Run;

/// A run of 40 steps that is evaluated every 20 by two episodes.
fn run() -> Run {
    let steps = [("experiment.steps", 40.into()), ("experiment.eval_interval", 20.into())];
    Run::new("hopper-demo", 3).set(&steps).set(&[("experiment.episodes", 2.into())])
}

fn listed(folder: &Path) -> Vec<Value> {
    serde_json::from_str(&printed(&["list", folder.to_str().unwrap(), "--json"])).unwrap()
}

#[test]
fn runs_are_listed_with_how_far_they_are_and_others_with_what_is_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let mut half = run();
    half.score(20, 0, 5.0, "a");
    half.score(20, 1, 7.0, "a");
    half.score(40, 0, 9.0, "b");
    half.write(&path("study/half"));
    fs::write(path("study/half/metrics.jsonl"), "{\"step\":30,\"seconds\":1.5}\n").unwrap();
    let mut whole = half.clone();
    whole.score(40, 1, 9.5, "b");
    whole.write(&path("whole"));
    fs::create_dir_all(path("other")).unwrap();
    fs::write(path("other/config.toml"), "[model]\nname = 'x'\n").unwrap();

    let learner = File::open(path("study/half/scores.jsonl")).unwrap();
    learner.lock().unwrap();
    let entries = listed(folder.path());
    let names: Vec<_> = entries.iter().map(|entry| entry["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["other", "study/half", "whole"]);
    assert!(entries[0]["error"].as_str().unwrap().contains("config.toml, line 1, is not what a learner writes"));
    for (entry, key, value) in [
        (1, "state", json!("30 of 40 steps")),
        (1, "at_work", json!(true)),
        (1, "score", json!(6.0)),
        (1, "score_step", json!(20)),
        (2, "state", json!("complete")),
        (2, "at_work", json!(false)),
        (2, "score", json!(9.25)),
        (2, "task", json!("hopper-demo")),
    ] {
        assert_eq!(entries[entry][key], value, "{key} of {}", entries[entry]);
    }
    let bytes = |name: &str| fs::metadata(path("whole").join(name)).unwrap().len();
    assert_eq!(entries[2]["bytes"], bytes("config.toml") + bytes("scores.jsonl"));

    let text = printed(&["list", folder.path().to_str().unwrap()]);
    let line = |name: &str| text.lines().find(|line| line.starts_with(name)).unwrap();
    assert!(line("study/half").contains("30 of 40 steps, at work"), "{text}");
    assert!(line("study/half").contains("6.0 @20"), "{text}");
    assert!(line("other: ").contains("unknown field `model`"), "{text}");
    drop(learner);
    assert_eq!(listed(&path("study/half"))[0]["at_work"], false);
}

#[test]
fn a_folder_that_is_not_there_is_a_line() {
    assert_eq!(printed(&["list", "/nowhere"]), "no runs\n/nowhere: No such file or directory (os error 2)\n");
}
