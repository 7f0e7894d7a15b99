//! Scores and judgments in files of `learner export`.

use std::fs;
use std::path::Path;

use quad_policy::Header;
use quad_protocol::{Hash, Origin};
use quad_run::folder::RunDir;
use quad_run::results::{Conditions, Estimate, Judgment};
use serde_json::{Value, json};

use crate::{learner, printed, write_dataset};

/// A run with two snapshots and without scores; gives the hash of both.
fn train(folder: &Path) -> (RunDir, String) {
    let [data, run] = ["data.hdf5", "run"].map(|name| folder.join(name));
    write_dataset(&data);
    printed(&format!(
        "train --task hopper-demo --dataset {} --run-dir {} --http 127.0.0.1:0 --steps 10 \
         --episodes 2 --eval-interval 0 --set batch_size=8 --agent actor.hidden=[8] \
         --agent critic.hidden=[8]",
        data.display(),
        run.display()
    ));
    let run = RunDir::at(&run);
    fs::copy(run.snapshot_path(10), run.snapshot_path(5)).unwrap();
    let weights = Hash::new(&run.read_snapshot(10).unwrap()).to_string();
    (run, weights)
}

/// Scores each episode: its step, its seed, its score and the weights.
fn score(run: &RunDir, episodes: &[(u64, u64, f64, &str)]) {
    let line = |(step, seed, score, weights): &(u64, u64, f64, &str)| {
        let line = json!({"step": step, "seed": seed, "return": 1.0, "length": 5, "score": score, "weights": weights,
                          "precision": "f32-avx512", "evaluator": "e"});
        format!("{line}\n")
    };
    let lines = String::from_iter(episodes.iter().map(line));
    fs::write(run.path().join("scores.jsonl"), lines).unwrap();
}

pub fn judge(run: &RunDir, step: u64, distance: f64, weights: &str) {
    let estimate = Estimate { values: vec![1.0, 1.0], doubts: Vec::new() };
    let judgment = Judgment {
        run: run.path().to_owned(),
        step,
        weights: weights.to_owned(),
        conditions: Conditions {
            dataset: "abc".to_owned(),
            environment: "hopper".to_owned(),
            episodes: vec![0],
            gamma: 0.99,
            steps: 100,
            seeds: 2,
        },
        estimate: estimate.clone(),
        distance,
        unseen: true,
        caveat: Some("it executes 2 actions".to_owned()),
        behavior: estimate,
        recorded: 1.0,
    };
    judgment.save(run).unwrap();
}

#[test]
fn a_judge_takes_the_data_of_a_run_from_where_it_is_now() {
    let folder = tempfile::tempdir().unwrap();
    let (run, _) = train(folder.path());
    let [data, other] = ["data.hdf5", "other.hdf5"].map(|name| folder.path().join(name));
    fs::remove_file(data).unwrap();
    crate::hopper::write_hopper(&other, 3, 50);
    let judged = |flags: &str| {
        let output = learner(&format!("judge {} {flags}", run.path().display()));
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    };
    let said = judged("");
    assert!(said.contains("hint: name the data of the run"), "{said}");
    let said = judged(&format!("--dataset {}", other.display()));
    assert!(said.contains("is not the data that"), "{said}");
}

/// Score and judgment in the file, and the text for the user.
fn export(run: &RunDir, step: &str) -> (Value, Value, String) {
    let out = run.path().join("policy.safetensors");
    let (run, file) = (run.path().display(), out.display());
    let output = learner(&format!("export {run} --step {step} --out {file} --license CC0"));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{said}");
    let about = Header::<Origin>::read(&fs::read(&out).unwrap()).unwrap().about;
    (about["score"].clone(), about["judgment"].clone(), said)
}

#[test]
fn a_file_has_the_score_and_judgment_of_its_own_step_and_weights() {
    let folder = tempfile::tempdir().unwrap();
    let (run, weights) = train(folder.path());
    let episode = |step, seed| (step, seed, if step == 5 { 30.0 } else { 20.0 }, &*weights);
    score(&run, &[episode(5, 0), episode(5, 1), episode(10, 0), episode(10, 1)]);
    [5, 10].iter().for_each(|step| judge(&run, *step, *step as f64, &weights));
    for (asked, step, expected) in
        [("5", 5, 30.0), ("10", 10, 20.0), ("last", 10, 20.0), ("best", 5, 30.0)]
    {
        let (score, judgment, said) = export(&run, asked);
        assert_eq!(score["step"], step);
        assert_eq!(score["score"]["mean"], expected);
        assert_eq!(score["complete"], true);
        assert_eq!(judgment["distance"], step as f64);
        assert_eq!(judgment["caveat"], "it executes 2 actions");
        assert!(!said.contains("WARN"), "{said}");
    }
    // The best of the snapshots that are left.
    let [there, away] = [run.snapshot_path(5), run.path().join("away")];
    fs::rename(&there, &away).unwrap();
    assert_eq!(export(&run, "best").0["step"], 10);
    fs::rename(&away, &there).unwrap();

    score(&run, &[episode(5, 0), episode(10, 0), (10, 1, 20.0, "00")]);
    judge(&run, 10, 1.0, "00");
    let (part, judgment, said) = export(&run, "5");
    assert_eq!(part["episodes"], 1);
    assert_eq!(part["complete"], false);
    assert!(said.contains("the score is of 1 of 2 episodes"), "{said}");
    assert_ne!(judgment, Value::Null);
    let of_other_weights = export(&run, "10");
    assert_eq!(of_other_weights.0, Value::Null);
    assert_eq!(of_other_weights.1, Value::Null);
    let said = of_other_weights.2;
    assert!(said.contains("that of step 10 is of other weights"), "{said}");
}
