//! A study of which some runs cannot begin.

use std::fs;

use crate::{learner, write_dataset};

#[test]
fn a_run_that_cannot_begin_fails_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    write_dataset(path("data.hdf5").as_ref());
    let study = format!(
        "about = 'x'\n[run]\ntask = 'hopper-demo'\nsteps = 10\neval_interval = 0\nagent.actor.hidden = [8]\n\
         agent.critic.hidden = [8]\n[axes]\nmethod = ['large', 'absent', 'small']\nseed = [0]\n\
         [method.large]\nbatch_size = 999999\ndataset = '{data}'\n[method.absent]\ndataset = '{absent}'\n\
         [method.small]\nbatch_size = 8\ndataset = '{data}'\n",
        data = path("data.hdf5"),
        absent = path("absent.hdf5"),
    );
    fs::write(path("study.toml"), study).unwrap();
    let sweep = |runs: &str, flags: &[&str]| {
        let output = learner(
            &[&["sweep", &path("study.toml"), &path(runs), "--evaluators", "0"], flags].concat(),
        );
        (output.status.code(), String::from_utf8(output.stderr).unwrap())
    };
    let (large, absent) =
        ("large-seed0: 98 transitions are fewer than a batch of 999999", "absent-seed0: ");
    let (code, said) = sweep("all", &[]);
    assert_eq!(code, Some(1), "{said}");
    for words in [
        "training takes about",
        "2 of 3 runs have failed",
        large,
        absent,
        "small-seed0 is complete",
    ] {
        assert!(said.contains(words), "{words} is not in {said}");
    }
    let begun = said.find("training takes about").unwrap();
    assert!(
        said[..begun].contains("large-seed0 cannot begin: 98 transitions"),
        "before any begins: {said}"
    );

    for (index, code, words) in
        [("0", 1, large), ("1", 1, absent), ("2", 0, "small-seed0 is complete")]
    {
        let (ended, said) = sweep("each", &["--index", index]);
        assert_eq!(ended, Some(code), "{said}");
        assert!(said.contains(words), "{words} is not in {said}");
    }
    for runs in ["all", "each"] {
        let output = learner(&["sweep", &path("study.toml"), &path(runs), "--list"]);
        let listed = String::from_utf8(output.stdout).unwrap();
        let states: Vec<_> =
            listed.lines().skip(1).map(|line| line.split_once("seed0").unwrap().1.trim()).collect();
        assert!(states[0].starts_with("failed") && states[1].starts_with("failed"), "{listed}");
        assert_eq!(states[2], "complete", "{listed}");
    }
}
