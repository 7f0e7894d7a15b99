//! `learner list`: what is where, and how far it is.

use std::fs::{self, File};

use serde_json::{Value, json};

use crate::run::Run;
use crate::{learner, printed};

#[test]
fn runs_are_listed_with_how_far_they_are_and_others_with_what_is_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let steps =
        [("experiment.steps", 40), ("experiment.eval_interval", 20), ("experiment.episodes", 2)];
    let mut half = Run::new("hopper-demo", 3).set(&steps.map(|(key, value)| (key, value.into())));
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
    let at_work = File::open(path("study/half/scores.jsonl")).unwrap();
    at_work.lock().unwrap();

    let asked = ["list", folder.path().to_str().unwrap(), "--json"];
    let listed = |arguments: &[&str]| {
        let output = learner(arguments);
        let [text, errors] =
            [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap());
        assert_eq!(output.status.code(), Some(1), "a run cannot be read: {errors}");
        (text, errors)
    };
    let (text, errors) = listed(&asked);
    let entries: Vec<Value> = serde_json::from_str(&text).unwrap();
    assert!(errors.contains("other: ") && !errors.contains("whole"), "{errors}");
    let names: Vec<_> = entries.iter().map(|entry| entry["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["other", "study/half", "whole"]);
    assert!(
        entries[0]["error"]
            .as_str()
            .unwrap()
            .contains("config.toml, line 1, is not what a learner writes")
    );
    let bytes = |name: &str| fs::metadata(path("whole").join(name)).unwrap().len();
    for (entry, key, value) in [
        (1, "state", json!("30 of 40 steps")),
        (1, "at_work", json!(true)),
        (1, "score", json!(6.0)),
        (2, "state", json!("complete")),
        (2, "at_work", json!(false)),
        (2, "score", json!(9.25)),
        (2, "bytes", json!(bytes("config.toml") + bytes("scores.jsonl"))),
    ] {
        assert_eq!(entries[entry][key], value, "{key} of {}", entries[entry]);
    }
    let (text, errors) = listed(&[asked[0], asked[1], "/nowhere"]);
    let line = |words: &str| text.lines().find(|line| line.contains(words)).unwrap();
    assert!(line("study/half").contains("30 of 40 steps, at work"), "{text}");
    assert!(line("study/half").contains("6.0 @20"), "{text}");
    let error = |words: &str| errors.lines().find(|line| line.contains(words)).unwrap();
    assert!(error("other: ").contains("unknown field `model`"), "{errors}");
    assert!(error("/nowhere: ").contains("No such file"), "{errors}");
    assert!(!text.contains("/nowhere"), "{text}");
    fs::remove_dir_all(path("other")).unwrap();
    assert!(printed(&asked[..2]).contains("whole"));
}
