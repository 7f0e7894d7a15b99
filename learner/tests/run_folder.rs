//! A run folder as the learner writes it, and the report and the picture made from it.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;

use quad_dataset::RewardRule;
use quad_learner::config::{DatasetInfo, RunConfig, RunInfo, resolve};
use quad_learner::device::Device;
use quad_learner::plot::learning_curves;
use quad_learner::report::{Report, RunReport};
use quad_learner::run_dir::{RunDir, RunDirError, ScoreLine};
use toml::Table;

fn config(name: &str, seed: u64) -> RunConfig {
    let mut experiment = resolve("hopper-demo", &Table::new()).unwrap();
    (experiment.seed, experiment.episodes) = (seed, 2);
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
            sha256: None,
            transitions: 100,
            episodes: 3,
            min_return: 10.0,
            mean_return: 20.0,
            max_return: 30.0,
            mean_score: Some(10.7),
        },
        experiment,
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
    write_changed_run(path, seed, shift, |_| ());
}

fn write_changed_run(path: &Path, seed: u64, shift: f64, change: impl Fn(&mut RunConfig)) {
    let name = path.file_name().unwrap().to_str().unwrap();
    let mut config = config(name, seed);
    change(&mut config);
    let mut log = RunDir::create(path, &config).unwrap().1;
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
    // Evaluations are due every 2000 of 20,000 steps; these are of the first six thousand.
    let missing: Vec<_> = report.missing.iter().map(|missing| (missing.step, missing.episodes)).collect();
    assert_eq!((missing[0], missing[1], missing.len()), ((6000, 1), (8000, 2), 8));
    let table = report.table();
    for text in [
        "10.00 ± 1.41",
        "1 (part)",
        "last 3 evaluations: 8.00",
        "last 5 evaluations: 6.00",
        "dataset:            10.70",
        "in f32",
        "15 episodes of steps 6000 to 20000 have no score",
    ] {
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
    for text in [report.text(), report.markdown()] {
        assert!(text.contains("10.00 ± 2.83"), "{text}");
    }
    let json: serde_json::Value = serde_json::to_value(&report).unwrap();
    assert_eq!(json["runs"][1]["evaluations"][0]["score"]["mean"], 6.0);
}

/// A run of its own folder beside the plain one: the report on both.
fn beside_a_plain_run(change: impl Fn(&mut RunConfig), score: impl Fn(&mut ScoreLine)) -> Report {
    let folder = tempfile::tempdir().unwrap();
    let paths: Vec<_> = ["a", "b"].map(|name| folder.path().join(name)).into();
    write_run(&paths[0], 0, 0.0);
    write_changed_run(&paths[1], 1, 0.0, change);
    let run = RunDir::open(&paths[1]).unwrap().0;
    let mut lines = run.read_scores().unwrap();
    lines.iter_mut().for_each(score);
    std::fs::remove_file(paths[1].join("scores.jsonl")).unwrap();
    run.score_log().unwrap().append(&lines).unwrap();
    Report::read(&paths).unwrap()
}

#[test]
fn unlike_runs_are_no_seeds_of_each_other_and_the_report_says_what_differs() {
    type Change = (&'static [&'static str], fn(&mut RunConfig));
    let changes: [Change; 6] = [
        (&["agent.tau = 0.1", "agent.tau = 0.5"], |config| {
            drop(config.experiment.agent.insert("tau".into(), 0.5.into()))
        }),
        (&["candidates = 10", "candidates = 1"], |config| config.experiment.candidates = 1),
        (&["device = cpu", "device = cuda"], |config| config.run.device = Device::Cuda),
        (&["dataset.mean_return = 20.0", "dataset.mean_return = 21.0"], |config| config.dataset.mean_return = 21.0),
        (&["no agent.eta.threshold", "agent.eta.threshold = 1.0"], |config| {
            config.experiment.agent["eta"].as_table_mut().unwrap().insert("threshold".into(), 1.0.into());
        }),
        (&["reward = \"locomotion\"", "reward = \"as-is\""], |config| config.experiment.reward = RewardRule::AsIs),
    ];
    for (keys, change) in changes {
        let report = beside_a_plain_run(change, |_| ());
        let differs: Vec<_> = report.groups.iter().flat_map(|group| &group.differs).collect();
        assert_eq!(differs, keys);
        assert!(keys.iter().all(|key| report.text().contains(key)), "{}", report.text());
    }
    let report = beside_a_plain_run(|_| (), |line| line.precision = "bf16-amx".into());
    let differs: Vec<_> = report.groups.iter().flat_map(|group| &group.differs).collect();
    assert_eq!(differs, ["scored in = f32", "scored in = bf16"]);

    let report = beside_a_plain_run(
        |config| {
            config.dataset.path = "elsewhere.hdf5".into();
            config.experiment.dataset = Some("elsewhere.hdf5".into());
        },
        |_| (),
    );
    assert_eq!(report.groups.len(), 1, "the same file lies in two places");
    assert!(report.groups[0].differs.is_empty());
    let report = beside_a_plain_run(|config| config.dataset.sha256 = Some("00".into()), |_| ());
    assert_eq!(report.groups.len(), 2, "of one of them the contents are known");
    assert!(report.groups[1].differs.contains(&"dataset.sha256 = \"00\"".to_owned()));
}

#[test]
fn a_seed_counts_once_and_a_run_without_a_complete_evaluation_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let paths: Vec<_> = ["a", "b", "c"].map(|name| folder.path().join(name)).into();
    write_run(&paths[0], 0, 0.0);
    write_run(&paths[1], 0, 4.0);
    RunDir::create(&paths[2], &config("c", 1)).unwrap();
    // A run that has no score yet says nothing of its precision, so it stands by itself.
    let report = Report::read(&paths).unwrap();
    assert_eq!(report.groups[0].seeds, [0]);
    assert_eq!(report.groups[0].mean_last_5.unwrap().mean, 6.0, "the first is counted");
    let text = report.text();
    assert!(text.contains("b has seed 0 like") && text.contains("c has no complete evaluation"), "{text}");
}

/// A run of the paper's preset with an evaluation of two episodes every 20,000 steps, from `first` to the end.
fn write_paper_run(path: &Path, seed: u64, first: u64, score: impl Fn(u64) -> f64) {
    let mut config = config(path.file_name().unwrap().to_str().unwrap(), seed);
    config.run.preset = "hopper-medium-replay-v2".into();
    config.experiment = resolve("hopper-medium-replay-v2", &Table::new()).unwrap();
    config.experiment.seed = seed;
    let mut log = RunDir::create(path, &config).unwrap().1;
    for step in (first..=2_000_000).step_by(20_000) {
        let lines: Vec<_> = (0..10).map(|episode| line(step, episode, score(step) + seed as f64)).collect();
        log.append(&lines).unwrap();
    }
}

#[test]
fn the_papers_protocol_stands_beside_the_papers_figures() {
    let folder = tempfile::tempdir().unwrap();
    let paths: Vec<_> = (0..4).map(|seed| folder.path().join(format!("seed{seed}"))).collect();
    // The last five: 1,920,000 to 2,000,000; the last 50,000 steps: 1,960,000 to 2,000,000. An early best one counts nowhere.
    let score = |step| if step == 20_000 { 1000.0 } else { step as f64 / 20_000.0 };
    for (seed, path) in (0..).zip(&paths) {
        write_paper_run(path, seed, 20_000, score);
    }
    let report = Report::read(&paths).unwrap();
    let [group] = &report.groups[..] else { panic!("one group, not {:?}", report.groups) };
    assert_eq!((group.mean_last_5.unwrap().mean, group.mean_last_50000_steps.unwrap().mean), (99.5, 100.5));
    assert_eq!(group.departures, [] as [&str; 0]);
    for text in [report.text(), report.markdown()] {
        for words in ["99.50 ± 1.29", "100.50 ± 1.29", "104.9 ± 0.2", "103.4 ± 0.2", "DQL", "IQL"] {
            assert!(text.contains(words), "{words} is missing in\n{text}");
        }
        assert!(text.contains("last 5 evaluations; 4 seeds, 2000000 steps on cpu, scored in f32"), "{text}");
        assert!(!text.contains("Not the paper's"), "{text}");
    }
    assert!(report.markdown().contains("\n| --- |"), "{}", report.markdown());
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["groups"][0]["published"][0]["score"]["mean"], 104.9);
}

#[test]
fn what_is_not_the_papers_protocol_is_called_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    write_paper_run(&path, 0, 1_000_000, |_| 50.0);
    let text = std::fs::read_to_string(path.join("config.toml")).unwrap();
    let text =
        text.replace("tau = 0.1", "tau = 1.0").replace("dataset = \"hopper-medium-replay-v2\"", "dataset = \"x.hdf5\"");
    std::fs::write(path.join("config.toml"), text).unwrap();
    let report = Report::read(std::slice::from_ref(&path)).unwrap();
    let expected = [
        "dataset is x.hdf5, not hopper-medium-replay-v2",
        "agent.tau is 1.0, not 0.1",
        "51 of 100 evaluations are complete",
        "1 of 4 seeds",
    ];
    assert_eq!(report.groups[0].departures, expected);
    assert!(expected.iter().all(|words| report.text().contains(words)), "{}", report.text());

    // The named file in another place, known by its checksum.
    let text = std::fs::read_to_string(path.join("config.toml")).unwrap();
    let sha256 = "e121c5f7c9857a307baa9edc6a2c3b48e85fedb9ac316ecddd0f48ca7ef4e39b";
    let text = text.replace("[dataset]", &format!("[dataset]\nsha256 = \"{sha256}\""));
    std::fs::write(path.join("config.toml"), text).unwrap();
    assert_eq!(Report::read(&[path]).unwrap().groups[0].departures, expected[1..]);
}

#[test]
fn scores_without_references_are_called_returns() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    write_changed_run(&path, 0, 0.0, |config| {
        config.experiment.environment = "my-robot".into();
        config.dataset.mean_score = None;
    });
    let report = Report::read(std::slice::from_ref(&path)).unwrap();
    let text = report.text();
    assert!(text.contains("mean return of the dataset") && !text.contains("score "), "{text}");
    let picture = folder.path().join("curve.svg");
    learning_curves(&picture, &report.runs).unwrap();
    assert!(!std::fs::read_to_string(picture).unwrap().contains("normalised"));
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
    assert!(!RunDir::is_occupied(&path));
    RunDir::create(&path, &config("a", 0)).unwrap();
    assert!(matches!(RunDir::create(&path, &config("a", 1)), Err(RunDirError::Occupied(_))));
    let (run, found) = RunDir::open(&path).unwrap();
    assert_eq!(found, config("a", 0));

    // Set aside, it is still there, and so is one that was set aside before.
    for _ in 0..2 {
        RunDir::open(&path).unwrap().0.set_aside().unwrap();
        RunDir::create(&path, &config("a", 2)).unwrap();
    }
    assert_eq!(RunDir::open(&folder.path().join("a.old1")).unwrap().1, config("a", 0));
    assert_eq!(RunDir::open(&folder.path().join("a.old2")).unwrap().1, config("a", 2));
    drop(run);
}

/// Both saw that it was empty.
#[test]
fn of_two_learners_that_begin_at_once_one_is_refused_and_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    std::fs::create_dir_all(&path).unwrap();
    // What the first one does before it writes the configuration.
    let first = RunDir::create(&path, &config("a", 0)).unwrap();
    std::fs::remove_file(path.join("config.toml")).unwrap();
    assert!(matches!(RunDir::create(&path, &config("a", 1)), Err(RunDirError::InUse(_))));
    assert!(!RunDir::is_occupied(&path));
    drop(first);
    RunDir::create(&path, &config("a", 1)).unwrap();
}

#[test]
fn a_new_run_does_not_take_over_scores_of_unknown_origin() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a");
    write_run(&path, 0, 0.0);
    std::fs::remove_file(path.join("config.toml")).unwrap();
    assert!(matches!(RunDir::create(&path, &config("a", 1)), Err(RunDirError::Occupied(_))));
}

#[test]
fn one_learner_at_a_time_works_in_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let (run, log) = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap();
    assert!(matches!(run.score_log(), Err(RunDirError::InUse(path)) if path == run.path()));
    drop(log);
    run.score_log().unwrap();
}

#[test]
fn metrics_of_steps_that_come_again_are_cut_off() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap().0;
    let row = |step: u64| serde_json::json!({ "step": step, "seconds": step as f64 / 10.0, "eta": 1.0 });
    let (mut log, seconds) = run.metrics_log(0).unwrap();
    assert_eq!(seconds, 0.0);
    log.append(&[row(100), row(200), row(300)]).unwrap();
    drop(log);
    let (mut log, seconds) = run.metrics_log(250).unwrap();
    assert_eq!(seconds, 20.0);
    log.append(&[row(300)]).unwrap();
    let text = std::fs::read_to_string(run.path().join("metrics.jsonl")).unwrap();
    let steps: Vec<_> =
        text.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap()["step"].clone()).collect();
    assert_eq!(steps, [100, 200, 300]);
}

#[test]
fn scores_survive_a_reopened_log_and_an_unfinished_line_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::create(&folder.path().join("a"), &config("a", 0)).unwrap().0;
    run.score_log().unwrap().append(&[line(1, 1, 0.1)]).unwrap();
    run.score_log().unwrap().append(&[line(1, 2, 0.2)]).unwrap();
    let path = run.path().join("scores.jsonl");
    let mut text = std::fs::read_to_string(&path).unwrap();
    text.push_str("{\"step\":1,");
    std::fs::write(&path, &text).unwrap();
    assert_eq!(run.read_scores().unwrap(), [line(1, 1, 0.1), line(1, 2, 0.2)]);

    // Whoever goes on cuts it off first, however long it is.
    for tail in ["", &"x".repeat(200_000)] {
        std::fs::write(&path, format!("{text}{tail}")).unwrap();
        run.score_log().unwrap().append(&[line(1, 3, 0.3)]).unwrap();
        assert_eq!(run.read_scores().unwrap(), [line(1, 1, 0.1), line(1, 2, 0.2), line(1, 3, 0.3)]);
    }

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
