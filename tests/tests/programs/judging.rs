//! Policies judged without a simulator, and the file that takes one of them to a robot.

use std::fs;
use std::path::{Path, PathBuf};

use quad_policy::{Header, Precision, load_policy};
use quad_protocol::Origin;
use quad_tests::process::{command, succeeds};
use serde_json::Value;

use crate::own_data::{train, write_log};

/// Two short runs on the log of a robot, which hold out two episodes of it.
fn runs(folder: &Path) -> [PathBuf; 2] {
    write_log(&folder.join("robot.hdf5"), 1.0);
    [("quad", "chunk=2"), ("iql", "value.hidden=[32]")].map(|(name, value)| {
        let run = folder.join("runs").join(name);
        let data = folder.join("robot.hdf5");
        let flags = format!("--algorithm {name} --agent {value}");
        train(data.to_str().unwrap(), run.to_str().unwrap(), &flags);
        run
    })
}

/// The judgment, and the log.
fn judge(paths: &[&Path], flags: &str) -> (Value, String) {
    let paths = Vec::from_iter(paths.iter().map(|path| path.to_str().unwrap())).join(" ");
    let output = command(&format!("learner judge {paths} --json {flags}")).output().unwrap();
    let log = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{log}");
    (serde_json::from_slice(&output.stdout).unwrap(), log)
}

#[test]
fn policies_are_judged_by_the_data_alone() {
    let scratch = tempfile::tempdir().unwrap();
    let [quad, iql] = runs(scratch.path());
    let all = scratch.path().join("runs");
    let short = "--steps 200";

    let (found, log) = judge(&[&quad], short);
    assert!(log.contains("judging takes about"), "{log}");
    let caveat =
        "judged as if each state were an episode's first, but it executes 2 actions of a chunk";
    assert_eq!(found["policies"][0]["caveat"], caveat);
    let (found, _) = judge(&[&all], short);
    let policies = found["policies"].as_array().unwrap();
    assert_eq!(policies.len(), 2);
    let verdict = found["verdict"].as_str().unwrap();
    assert!(verdict.contains("rank") || verdict.contains("told apart"), "{verdict}");
    for policy in policies {
        assert_eq!(policy["estimate"]["values"].as_array().unwrap().len(), 2, "two seeds");
        assert_eq!((&policy["unseen"], &policy["step"]), (&true.into(), &20.into()));
        assert!((0.1..3.0).contains(&policy["distance"].as_f64().unwrap()), "{policy}");
    }
    // The episodes have rewards 0, 1, …, 48 and are truncated there.
    let exact: f64 = (0..49).map(|t| 0.99_f64.powi(t) * f64::from(t)).sum();
    let recorded = found["recorded"].as_f64().unwrap();
    assert!((0.5 * exact..2.0 * exact).contains(&recorded), "{recorded}, of data {exact}");

    let (again, log) = judge(&[&all], short);
    assert!(!log.contains("judging"), "nothing is computed twice: {log}");
    assert_eq!(again, found);
    let [data, moved] = ["robot.hdf5", "moved.hdf5"].map(|name| scratch.path().join(name));
    fs::rename(&data, &moved).unwrap();
    let (here, _) = judge(&[&iql], &format!("--steps 100 --dataset {}", moved.display()));
    assert_eq!(here["conditions"]["dataset"], found["conditions"]["dataset"]);
    fs::rename(&moved, &data).unwrap();
    for (flags, key, value) in [
        ("--steps 200 --gamma 0.5", "gamma", Value::from(0.5)),
        ("--steps 200 --seeds 3", "seeds", 3.into()),
        ("--steps 100", "steps", 100.into()),
    ] {
        assert_eq!(judge(&[&quad], flags).0["conditions"][key], value, "{flags}");
    }
    // A policy that is named twice counts once.
    let snapshot = quad.join("snapshots/step_000000020.safetensors");
    let (twice, _) = judge(&[&quad, &snapshot, &all], short);
    assert_eq!(twice["policies"].as_array().unwrap().len(), 2);
    for run in [&quad, &iql] {
        let of = |policy: &&Value| policy["run"] == run.to_str().unwrap();
        let among = policies.iter().find(of).unwrap();
        assert_eq!(judge(&[run], short).0["policies"][0]["estimate"], among["estimate"]);
    }

    let html = scratch.path().join("report.html");
    let text = succeeds(&format!("learner report {} --html {}", all.display(), html.display()));
    for text in [text, fs::read_to_string(html).unwrap()] {
        assert!(text.contains("a ranking, not a score"), "{text}");
        assert!(text.contains("behavior, as recorded") && text.contains("of a chunk"), "{text}");
    }
}

#[test]
fn an_exported_policy_names_its_data_and_acts_alike() {
    let scratch = tempfile::tempdir().unwrap();
    let [quad, _] = runs(scratch.path());
    let (run, out) = (quad.display(), scratch.path().join("policy.safetensors"));
    succeeds(&format!("learner export {run} --out {} --step 20 --license CC0", out.display()));
    let [file, snapshot] = [&out, &quad.join("snapshots/step_000000020.safetensors")]
        .map(|path| fs::read(path).unwrap());
    let [header, original] = [&file, &snapshot].map(|file| Header::<Origin>::read(file).unwrap());
    assert_eq!((&header.policy, &header.origin), (&original.policy, &original.origin));
    assert_eq!(header.about["algorithm"], "quad");
    assert_eq!(header.about["data"]["license"], "CC0");
    assert_eq!(header.about["data"]["held_out"].as_array().unwrap().len(), 2);
    let act = |file: &[u8]| {
        let (policy, mut actions) = (load_policy(file, Precision::F32).unwrap(), vec![0.0; 2]);
        policy.act(&[0.1, 0.2, 0.3, 0.4, 0.5], &mut [policy.begin(7)], &mut actions).unwrap();
        actions
    };
    assert_eq!(act(&file), act(&snapshot));
}
