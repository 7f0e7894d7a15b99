//! A run folder as the learner writes it, and the report and the picture made from it.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;

use quad_learner::config::{DatasetInfo, RunConfig, RunInfo, resolve};
use quad_learner::device::Device;
use quad_learner::plot::learning_curves;
use quad_learner::report::{Report, RunReport};
use quad_learner::run_dir::{RunDir, RunDirError, ScoreLine};

fn config(name: &str, seed: u64) -> RunConfig {
    RunConfig {
        run: RunInfo {
            name: name.into(),
            incarnation: 1,
            preset: "hopper-demo".into(),
            version: "0.1.0".into(),
            device: Device::Cpu,
        },
        dataset: DatasetInfo {
            path: "data.hdf5".into(),
            transitions: 100,
            episodes: 3,
            min_return: 10.0,
            mean_return: 20.0,
            max_return: 30.0,
            mean_score: Some(10.7),
        },
        experiment: resolve(
            "hopper-demo",
            &[("seed".to_owned(), (seed as i64).into()), ("episodes".to_owned(), 2.into())].into_iter().collect(),
        )
        .unwrap(),
    }
}

fn line(step: u64, seed: u64, score: f64) -> ScoreLine {
    ScoreLine {
        step,
        seed,
        episode_return: 10.0 * score,
        length: 5,
        score,
        weights: "00".into(),
        precision: "f32".into(),
        evaluator: "e".into(),
    }
}

/// Complete evaluations with means 2, 4, 6, 8, 10 (+ shift), each ± √2, and half of a sixth.
fn write_run(path: &Path, seed: u64, shift: f64) {
    let name = path.file_name().unwrap().to_str().unwrap();
    let run = RunDir::create(path, &config(name, seed)).unwrap();
    let mut log = run.score_log().unwrap();
    for n in 1..=5 {
        let mean = 2.0 * n as f64 + shift;
        log.append(&[line(1000 * n, 1, mean - 1.0), line(1000 * n, 2, mean + 1.0)]).unwrap();
    }
    log.append(&[line(6000, 1, 99.0)]).unwrap();
}

#[test]
fn a_report_summarises_complete_evaluations() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    write_run(&path, 3, 0.0);
    let report = RunReport::read(&path).unwrap();
    assert_eq!((report.seed, &*report.variant, report.candidates, report.dataset_score), (3, "quad", 10, 10.7));
    let last = report.evaluations.last().unwrap();
    assert_eq!((last.step, last.episodes, last.complete, last.score.std), (6000, 1, false, None));
    let fifth = &report.evaluations[4];
    assert_eq!((fifth.score.mean, fifth.mean_return, fifth.mean_length, fifth.complete), (10.0, 100.0, 5.0, true));
    assert!((fifth.score.std.unwrap() - 2f64.sqrt()).abs() < 1e-12);
    assert_eq!((report.mean_last_3, report.mean_last_5), (Some(8.0), Some(6.0)));
    let table = report.table();
    for text in ["10.00 ± 1.41", "1 (part)", "last 3 evaluations: 8.00", "last 5 evaluations: 6.00", "10.70"] {
        assert!(table.contains(text), "{text} is missing in\n{table}");
    }
}

#[test]
fn several_runs_are_summarised_over_seeds() {
    let folder = tempfile::tempdir().unwrap();
    let paths: Vec<_> = ["a", "b"].map(|name| folder.path().join(name)).into();
    write_run(&paths[0], 0, 0.0);
    write_run(&paths[1], 1, 4.0);
    let report = Report::read(&paths).unwrap();
    let [group] = &report.groups[..] else { panic!("one group, not {:?}", report.groups) };
    assert_eq!(group.seeds, [0, 1]);
    let spread = group.mean_last_3.unwrap();
    assert_eq!(spread.mean, 10.0);
    assert!((spread.std.unwrap() - 8f64.sqrt()).abs() < 1e-12);
    assert!(report.table().contains("10.00 ± 2.83"), "{}", report.table());
    let json: serde_json::Value = serde_json::to_value(&report).unwrap();
    assert_eq!(json["runs"][1]["evaluations"][0]["score"]["mean"], 6.0);
}

#[test]
fn a_picture_shows_the_curve_and_the_reference() {
    let folder = tempfile::tempdir().unwrap();
    let paths: Vec<_> = ["a", "b"].map(|name| folder.path().join(name)).into();
    write_run(&paths[0], 0, 0.0);
    write_run(&paths[1], 1, 4.0);
    let runs = Report::read(&paths).unwrap().runs;
    let svg = |runs: &[RunReport]| {
        let picture = folder.path().join("curve.svg");
        learning_curves(&picture, runs).unwrap();
        std::fs::read_to_string(picture).unwrap()
    };
    let (one, both) = (svg(&runs[..1]), svg(&runs));
    for text in ["<svg", "gradient steps", "dataset mean 10.7", "<polygon"] {
        assert!(one.contains(text), "{text} is missing");
    }
    assert!(both.contains("b (quad, 10 candidates)"));
    assert!(both.matches("<circle").count() > one.matches("<circle").count());
}

#[test]
fn a_run_without_scores_has_a_report_too() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    RunDir::create(&path, &config("a", 0)).unwrap();
    let report = RunReport::read(&path).unwrap();
    assert_eq!((report.evaluations.len(), report.mean_last_3), (0, None));
    assert!(report.table().contains("no evaluation"));
    learning_curves(&path.join("curve.svg"), &[report]).unwrap();
}

#[test]
fn a_folder_with_a_run_in_it_is_not_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    RunDir::check_free(&path).unwrap();
    RunDir::create(&path, &config("a", 0)).unwrap();
    assert!(matches!(RunDir::create(&path, &config("a", 1)), Err(RunDirError::Occupied(_))));
    assert_eq!(RunDir::open(&path).unwrap().1, config("a", 0));
}

#[test]
fn scores_survive_a_reopened_log_and_an_unfinished_line_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap();
    run.score_log().unwrap().append(&[line(1, 1, 0.1)]).unwrap();
    run.score_log().unwrap().append(&[line(1, 2, 0.2)]).unwrap();
    let path = run.path().join("scores.jsonl");
    let mut text = std::fs::read_to_string(&path).unwrap();
    text.push_str("{\"step\":1,");
    std::fs::write(&path, &text).unwrap();
    assert_eq!(run.read_scores().unwrap(), [line(1, 1, 0.1), line(1, 2, 0.2)]);

    std::fs::write(&path, text + "\n").unwrap();
    let error = run.read_scores().unwrap_err().to_string();
    assert!(error.contains("scores.jsonl, line 3"), "{error}");
}

#[test]
fn score_lines_carry_the_words_that_scripts_read() {
    let json = serde_json::to_value(line(3, 4, 0.5)).unwrap();
    for key in ["step", "seed", "return", "length", "score", "weights", "evaluator"] {
        assert!(json.get(key).is_some(), "{key}");
    }
}
