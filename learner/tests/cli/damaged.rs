//! One damaged folder among others.

use std::fs;

use crate::learner;
use crate::run::Run;

#[test]
fn a_damaged_run_is_named_and_keeps_no_other_from_being_reported() {
    let folder = tempfile::tempdir().unwrap();
    let mut run = Run::new("hopper-demo", 0);
    run.score(1000, 0, 5.0, "00");
    for name in ["damaged", "whole"] {
        run.write(&folder.path().join(name));
    }
    fs::write(folder.path().join("damaged/scores.jsonl"), "{\"step\":10}\n").unwrap();
    let page = folder.path().join("page.html");
    let output =
        learner(&["report", folder.path().to_str().unwrap(), "--html", page.to_str().unwrap()]);
    let [text, said] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert_eq!(output.status.code(), Some(1), "{said}");
    let error = "damaged/scores.jsonl, line 1, is not what a learner writes";
    assert!(
        said.contains(error)
            && said.contains("error: 1 folders cannot be read")
            && said.contains("hint: "),
        "{said}"
    );
    let page = fs::read_to_string(page).unwrap().replace("&#x2f;", "/");
    for text in [text, page] {
        assert!(text.contains("hopper-demo") && text.contains(error), "{text}");
    }
}

#[test]
fn a_damaged_run_is_named_and_keeps_no_other_of_its_study_from_being_listed() {
    let folder = tempfile::tempdir().unwrap();
    let study = folder.path().join("seeds.toml");
    fs::write(&study, "about = 'x'\n[run]\ntask = 'hopper-demo'\ndataset = 'data.hdf5'\n[axes]\nseed = [0, 1, 2]\n")
        .unwrap();
    let damaged = folder.path().join("runs/seeds/seed1");
    fs::create_dir_all(&damaged).unwrap();
    fs::write(damaged.join("config.toml"), "[run\n").unwrap();
    let runs = folder.path().join("runs");
    let output = learner(&["sweep", study.to_str().unwrap(), runs.to_str().unwrap(), "--list"]);
    let [text, said] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert_eq!(output.status.code(), Some(1), "{said}");
    let states: Vec<_> =
        text.lines().skip(1).map(|line| line.split_once("seed").unwrap().1[1..].trim()).collect();
    assert_eq!(states, ["not begun", "cannot be read", "not begun"], "{text}");
    assert!(said.contains("seed1/config.toml, line 1, is not what a learner writes"), "{said}");
}
