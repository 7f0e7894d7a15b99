//! What is known of policies without a simulator, and the file that takes one of them to a robot.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use quad_policy::{Header, Precision, load_policy};
use quad_protocol::Origin;
use quad_tests::process::{assert_refused, binary};
use serde_json::Value;

use super::own_data::{said, train, write_log};

/// Two short runs on the log of a robot, which hold out two episodes of it.
fn runs(folder: &Path) -> [PathBuf; 2] {
    let data = folder.join("robot.hdf5");
    write_log(&data, 1.0);
    ["quad", "iql"].map(|name| {
        let run = folder.join("runs").join(name);
        let value: &[_] = if name == "iql" { &["--agent", "value.hidden=[32]"] } else { &[] };
        said(&train(&data, &run, &[&["--algorithm", name], value].concat()), 0);
        run
    })
}

fn learner(command: &str, arguments: &[&Path], flags: &[&str]) -> Output {
    Command::new(binary("learner")).arg(command).args(arguments).args(flags).output().unwrap()
}

fn json(output: &Output) -> Value {
    said(output, 0);
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn policies_are_judged_by_the_data_alone() {
    let scratch = tempfile::tempdir().unwrap();
    let [quad, iql] = runs(scratch.path());
    let all = scratch.path().join("runs");
    let judge = |paths: &[&Path]| learner("judge", paths, &["--json", "--steps", "200"]);

    let first = judge(&[&quad]);
    assert!(said(&first, 0).contains("judging 1 policies takes about"), "it forecasts");
    let found = json(&judge(&[&all]));
    let (policies, verdict) =
        (found["policies"].as_array().unwrap(), found["verdict"].as_str().unwrap());
    assert_eq!(policies.len(), 2);
    assert!(verdict.contains("rank") || verdict.contains("told apart"), "{verdict}");
    for policy in policies {
        assert_eq!(policy["estimate"]["values"].as_array().unwrap().len(), 2, "two seeds");
        assert_eq!((&policy["unseen"], &policy["step"]), (&true.into(), &20.into()));
        assert!((0.1..3.0).contains(&policy["distance"].as_f64().unwrap()), "{policy}");
    }
    // The episodes have rewards 0, 1, …, 48 and are cut off there.
    let exact: f64 = (0..49).map(|t| 0.99_f64.powi(t) * f64::from(t)).sum();
    let recorded = found["recorded"].as_f64().unwrap();
    assert!(
        (0.5 * exact..2.0 * exact).contains(&recorded),
        "{recorded} instead of {exact} and what comes after"
    );

    let again = judge(&[&all]);
    assert!(!said(&again, 0).contains("judging"), "nothing is computed twice");
    assert_eq!(json(&again), found);
    for (flag, key, value) in
        [("--gamma", "gamma", "0.5"), ("--seeds", "seeds", "3"), ("--steps", "steps", "100")]
    {
        let flags = ["--json", "--steps", "200"]
            .into_iter()
            .filter(|word| flag != "--steps" || *word == "--json");
        let other = json(&learner(
            "judge",
            &[&quad],
            &[&Vec::from_iter(flags)[..], &[flag, value]].concat(),
        ));
        assert_eq!(
            other["conditions"][key],
            value.parse::<Value>().unwrap(),
            "of other conditions nothing is known"
        );
    }
    let twice = json(&judge(&[&quad, &quad.join("snapshots/step_000000020.safetensors"), &all]));
    assert_eq!(
        twice["policies"].as_array().unwrap().len(),
        2,
        "a policy that is named twice counts once"
    );

    let alone = |path: &Path| json(&judge(&[path]))["policies"][0]["estimate"].clone();
    let of = |run: &Path| {
        policies.iter().find(|policy| policy["run"] == run.to_str().unwrap()).unwrap()["estimate"]
            .clone()
    };
    assert_eq!((alone(&quad), alone(&iql)), (of(&quad), of(&iql)));

    let html = scratch.path().join("report.html");
    let report = learner("report", &[&all], &["--html", html.to_str().unwrap()]);
    said(&report, 0);
    for text in [String::from_utf8(report.stdout).unwrap(), fs::read_to_string(html).unwrap()] {
        assert!(
            text.contains("a ranking, not a score") && text.contains("behavior, as recorded"),
            "{text}"
        );
    }
}

#[test]
fn what_cannot_be_judged_is_said_in_a_sentence() {
    let scratch = tempfile::tempdir().unwrap();
    let [quad, iql] = runs(scratch.path());
    let refused = |paths: &[&Path], sentence: &str, hint: &str| {
        assert_refused(&learner("judge", paths, &["--steps", "100"]), sentence, hint);
    };
    refused(&[&scratch.path().join("none")], "cannot read", "RUN/snapshots/step_");
    let stray = scratch.path().join("step_000000020.safetensors");
    fs::copy(quad.join("snapshots/step_000000020.safetensors"), &stray).unwrap();
    refused(&[&stray], "in no run's folder", "RUN/snapshots/step_");
    let config = iql.join("config.toml");
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("environment = \"my-robot\"", "environment = \"another\""))
        .unwrap();
    refused(
        &[&quad, &iql],
        "quad is of the environment my-robot, iql of another",
        "judge them apart",
    );
    let sha256 = text.split("sha256 = \"").nth(1).unwrap().split('"').next().unwrap().to_owned();
    fs::write(&config, text.replace(&sha256, &"0".repeat(64))).unwrap();
    refused(&[&quad, &iql], "have not learned from the same data", "judge them apart");
    refused(&[&iql], "is not the data that iql has learned from", "put a copy");
}

#[test]
fn an_exported_policy_says_what_it_has_learned_from_and_acts_alike() {
    let scratch = tempfile::tempdir().unwrap();
    let [quad, _] = runs(scratch.path());
    let out = scratch.path().join("policy.safetensors");
    let export = |flags: &[&str]| {
        learner("export", &[&quad], &[&["--out", out.to_str().unwrap()], flags].concat())
    };
    said(&export(&["--step", "20", "--license", "CC0"]), 0);
    let [file, snapshot] = [&out, &quad.join("snapshots/step_000000020.safetensors")]
        .map(|path| fs::read(path).unwrap());
    let (header, original) =
        (Header::<Origin>::read(&file).unwrap(), Header::<Origin>::read(&snapshot).unwrap());
    assert_eq!((&header.policy, &header.origin), (&original.policy, &original.origin));
    assert_eq!(
        (&header.about["data"]["license"], &header.about["algorithm"]),
        (&"CC0".into(), &"quad".into())
    );
    assert_eq!(header.about["data"]["held_out"].as_array().unwrap().len(), 2);
    let act = |file: &[u8]| {
        let (policy, mut actions) = (load_policy(file, Precision::F32).unwrap(), vec![0.0; 2]);
        policy.act(&[0.1, 0.2, 0.3, 0.4, 0.5], &mut [policy.begin(7)], &mut actions).unwrap();
        actions
    };
    assert_eq!(act(&file), act(&snapshot));

    assert_refused(
        &export(&["--step", "10"]),
        "has no snapshot after that step",
        "of the steps 20",
    );
    assert_refused(&export(&["--step", "best"]), "with a complete evaluation", "--step N");
    let nowhere = learner("export", &[&quad], &["--out", "/nowhere/policy"]);
    assert_refused(&nowhere, "cannot export to /nowhere/policy", "");
}

#[test]
fn of_a_runs_snapshots_the_last_is_judged_and_exported() {
    let scratch = tempfile::tempdir().unwrap();
    let (data, run) = (scratch.path().join("robot.hdf5"), scratch.path().join("run"));
    write_log(&data, 1.0);
    said(&train(&data, &run, &["--algorithm", "quad"]), 0);
    // An earlier one: what is in it does not matter.
    let snapshot = |step: u64| run.join(format!("snapshots/step_{step:09}.safetensors"));
    fs::copy(snapshot(20), snapshot(10)).unwrap();
    let out = scratch.path().join("policy.safetensors");
    let exported = learner("export", &[&run], &["--out", out.to_str().unwrap()]);
    said(&exported, 0);
    assert!(String::from_utf8(exported.stdout).unwrap().contains("run @ 20, "));
    let judged = json(&learner("judge", &[&run], &["--json", "--steps", "100"]));
    assert_eq!(judged["policies"][0]["step"], 20);
}
