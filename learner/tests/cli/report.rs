//! Numbers, figures and pages of `learner report`. Its texts are in report.trycmd, published.trycmd
//! and study.trycmd.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};

use crate::printed;
use crate::run::{HOPPER, Run, TASKS, complete, paper, small, write_all, write_study};

fn report(folder: &Path, flags: &str) -> Value {
    let text = printed(&format!("report {} --json {flags}", folder.display()));
    serde_json::from_str(&text).unwrap()
}

fn report_of(runs: impl IntoIterator<Item = Run>) -> Value {
    let folder = tempfile::tempdir().unwrap();
    write_all(folder.path(), runs);
    report(folder.path(), "")
}

/// Draws the figures of runs; gives the curve of their task.
fn curve(runs: &[Run]) -> String {
    let folder = tempfile::tempdir().unwrap();
    write_all(folder.path(), runs.iter().cloned());
    let figures = folder.path().join("figures");
    report(folder.path(), &format!("--figures {}", figures.display()));
    fs::read_to_string(figures.join("curve-hopper-demo.svg")).unwrap()
}

#[test]
fn json_has_the_numbers_of_runs_and_seeds() {
    let reported = report_of([small(3, 0.0)]);
    let run = &reported["runs"][0];
    for (key, value) in [
        ("/variant", json!("quad")),
        ("/seed", json!(3)),
        ("/dataset_score", json!(10.7)),
        ("/mean_last_3", json!(8.0)),
        ("/mean_last_5", json!(6.0)),
        ("/episodes_missing", json!(1)),
        ("/evaluations/4/score/mean", json!(10.0)),
        ("/evaluations/4/mean_return", json!(100.0)),
    ] {
        assert_eq!(run.pointer(key), Some(&value), "{key}");
    }
    let reported = report_of(paper(HOPPER, 2_000_000, |step| step as f64 / 20_000.0));
    let group = &reported["groups"][0];
    for (key, value) in [
        ("/mean_last_5/mean", json!(99.5)),
        ("/mean_last_50000_steps/mean", json!(100.5)),
        ("/departures", json!([])),
        ("/published/0/score/mean", json!(104.9)),
    ] {
        assert_eq!(group.pointer(key), Some(&value), "{key}");
    }
}

#[test]
fn a_study_has_interquartile_means_and_corrected_p_values() {
    let folder = tempfile::tempdir().unwrap();
    write_study(folder.path().to_str().unwrap());
    let report = || report(folder.path(), "");
    let reported = report();
    assert_eq!(reported, report(), "the same runs give the same intervals");
    let near = |pointer: &str, value: f64| {
        let found = reported.pointer(pointer).and_then(Value::as_f64).unwrap();
        assert!((found - value).abs() < 1e-9, "{pointer}: {found} {value}");
    };
    // Ten scores: 36, 39, 40, 42, 43, 86, 89, 90, 92, 93, of which two at either end are cut.
    near("/study/0/iqm/value", 390.0 / 6.0);
    near("/study/0/mean/value", 65.0);
    near("/study/0/optimality_gap/value", 0.35);
    let profile = reported["study"][0]["profile"].as_array().unwrap();
    for (threshold, share) in [(0.0, 1.0), (50.0, 0.5), (92.0, 0.1)] {
        assert_eq!(
            profile.iter().find(|one| one["threshold"] == threshold).unwrap()["value"],
            share
        );
    }
    near("/comparisons/2/mean_difference", 15.0);
    near("/comparisons/2/probability_of_improvement/value", 1.0);
    // Of 1024 ways to choose ten signs, two are as far from 0; Holm triples the smallest of three.
    near("/comparisons/2/p", 2.0 / 1024.0);
    near("/comparisons/2/p_holm", 6.0 / 1024.0);
}

/// The methods of a study with the tasks of each, given task, environment and τ of each run.
fn methods(runs: &[(&str, &str, f64)]) -> Vec<(String, Value)> {
    let run = |(task, environment, tau): &(&str, &str, f64)| {
        let run = Run::new("hopper-demo", 0)
            .set("run.preset", *task)
            .set("experiment.environment", *environment)
            .set("dataset.mean_return", if *environment == "hopper" { 20.0 } else { *tau })
            .set("experiment.agent.tau", *tau);
        complete(run, 40.0)
    };
    let report = report_of(runs.iter().map(run));
    let rows = report["study"].as_array().unwrap().iter();
    rows.map(|row| (row["method"].as_str().unwrap().to_owned(), row["tasks"].clone())).collect()
}

#[test]
fn a_method_is_called_by_values_that_are_not_its_tasks_own() {
    let row = |tau: &str, tasks: &[&str]| (format!("quad{tau}"), json!(tasks));
    let [hopper, walker] = TASKS;
    let [own, half] = ["", ", agent.tau = 0.5"];
    let of_walker = (walker, "walker2d", 0.5);
    // A study that is half done: on Walker2d there are only runs whose τ is not the task's own.
    let found = methods(&[(hopper, "hopper", 0.1), of_walker]);
    assert_eq!(found, [row(own, &[hopper]), row(half, &[walker])]);
    let found = methods(&[(hopper, "hopper", 0.1), (hopper, "hopper", 0.5), of_walker]);
    assert_eq!(found, [row(own, &[hopper]), row(half, &TASKS)]);
    // The report does not know which τ is the own one of a user's task.
    let found = methods(&[("mine-a", "hopper", 0.1), ("mine-b", "walker2d", 0.5)]);
    assert_eq!(found, [row(", agent.tau = 0.1", &["mine-a"]), row(half, &["mine-b"])]);
    let found = methods(&[(hopper, "hopper", 0.1), ("mine", "walker2d", 0.5)]);
    assert_eq!(found, [row(own, &[hopper]), row(half, &["mine"])]);
    let found = methods(&[("mine-a", "hopper", 0.5), ("mine-b", "walker2d", 0.5)]);
    assert_eq!(found, [row(own, &["mine-a", "mine-b"])]);
}

#[test]
fn methods_are_compared_seed_by_seed_and_returns_apart_from_scores() {
    let run = |task: &str, guidance: &str, seed, score| {
        let run = match task {
            "my-robot" => Run::new("own-data", seed)
                .set("experiment.environment", "my-robot")
                .set("run.preset", "my-robot"),
            known => Run::new(known, seed),
        };
        complete(run.set("experiment.agent.guidance", guidance), score)
    };
    let quad = [(0, 10.0), (1, 20.0), (2, 30.0)];
    let dac = [(2, 31.0), (1, 22.0), (3, 5.0)];
    let of = |method, scores: [(u64, f64); 3]| {
        scores.map(|(seed, score)| run(TASKS[0], method, seed, score))
    };
    let report = report_of(of("quad", quad).into_iter().chain(of("dac", dac)));
    let comparisons = report["comparisons"].as_array().unwrap();
    let comparison = comparisons.iter().find(|one| one["p"].is_number()).unwrap();
    let difference = if comparison["against"] == "quad" { 1.5 } else { -1.5 };
    assert_eq!(comparison["pairs"], 2);
    assert_eq!(comparison["mean_difference"], difference);

    // A robot without reference returns is in no mean with one that has them.
    let robot = "my-robot";
    let report = report_of([
        run(TASKS[0], "quad", 0, 40.0),
        run(robot, "quad", 0, 900.0),
        run(robot, "dac", 0, 950.0),
    ]);
    let study = report["study"].as_array().unwrap();
    let means = study.iter().map(|one| one["mean"]["value"].as_f64().unwrap());
    assert_eq!(Vec::from_iter(means), [40.0, 900.0, 950.0]);
    assert_eq!(study[1]["iqm"], json!({ "value": 900.0, "low": null, "high": null }));
    assert_eq!(study[1]["optimality_gap"], Value::Null);
    let [comparison] = &report["comparisons"].as_array().unwrap()[..] else { panic!("{report}") };
    assert_eq!(comparison["tasks"], json!([robot]));
    assert_eq!(comparison["mean_difference"], 50.0);
}

#[test]
fn figures_and_tables_come_in_the_formats_of_papers() {
    let folder = tempfile::tempdir().unwrap();
    write_study(folder.path().to_str().unwrap());
    let figures = folder.path().join("figures");
    let latex = printed(&format!(
        "report {} --latex --figures {}",
        folder.path().display(),
        figures.display()
    ));
    assert!(latex.contains("\\begin{tabular}{llrrrrr}\n\\toprule\nmethod & tasks & seeds & IQM"));
    assert!(latex.lines().any(|line| line.starts_with("iql & 2 & 5 & 80.00 [")), "{latex}");
    for (name, label) in [
        ("profile", "iql"),
        ("curve-hopper-demo", "iql"),
        ("curve-walker2d-demo", "iql"),
        ("tau", "τ"),
    ] {
        let png = fs::read(figures.join(format!("{name}.png"))).unwrap();
        assert!(png.starts_with(b"\x89PNG\r\n\x1a\n") && png.len() > 10_000, "{name}");
        let svg = fs::read_to_string(figures.join(format!("{name}.svg"))).unwrap();
        assert!(svg.starts_with("<svg") && svg.contains("<polygon"), "{name}");
        assert!(svg.contains("quad") && svg.contains(label), "{name}: {svg}");
        // The axis of τ names whole powers of ten.
        let ticks = if name == "tau" { &["\n0.1\n", "\n1\n", "\n10\n"][..] } else { &[] };
        assert!(ticks.iter().all(|tick| svg.contains(tick)), "{svg}");
    }
}

#[test]
fn curves_show_complete_evaluations_only() {
    let runs = [small(0, 0.0), small(1, 1.0)];
    let mut without_part = runs.clone();
    without_part.iter_mut().for_each(|run| drop(run.scores.pop()));
    assert_eq!(curve(&runs), curve(&without_part));

    let [mut complete, mut stopped] = runs;
    complete.score(6000, 0, 12.0, "00");
    stopped.scores.truncate(4);
    assert!(curve(&[complete, stopped]).contains("quad (1 seed, not complete)"));

    let mut robot = small(0, 0.0).set("experiment.environment", "my-robot");
    robot.scores.iter_mut().for_each(|line| line["return"] = line["score"].clone());
    assert!(!curve(&[robot]).contains("normalized"));
}

#[test]
fn a_page_is_one_file_and_escapes_what_it_shows() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let dataset = "<script>alert(1)</script>.hdf5";
    small(3, 0.0).set("experiment.dataset", dataset).write(path("a"));
    small(4, 1.0).write(path("b"));
    small(5, 1.0).write(path("damaged"));
    fs::write(path("a/film.gif"), "GIF89a of a run").unwrap();
    let [page, b] = ["page.html", "b"].map(|name| path(name).display().to_string());
    printed(&format!("report {} {b} --html {page}", path("a").display()));
    let text = fs::read_to_string(&page).unwrap().replace("&#x2f;", "/");
    assert!(!text.contains("<script") && text.contains("&lt;script&gt;alert(1)"), "{text}");
    // Nothing is fetched: neither scripts nor pictures have addresses.
    assert!(["href=\"http", "src=\"/", "url("].iter().all(|words| !text.contains(words)), "{text}");
    for words in [
        "<svg",
        "src=\"data:image/gif;base64,R0lGODlhIG9mIGEgcnVu\"",
        &format!("--seed 4 --run-dir {b}"),
        "8.50 ± 0.71 (0.50)",
        "steps = 6000",
        "100 transitions of 3 episodes",
    ] {
        assert!(text.contains(words), "{words} is missing in\n{text}");
    }

    fs::write(path("damaged/scores.jsonl"), "{\"step\":10}\n").unwrap();
    crate::learner(&format!("report {} --html {page}", folder.path().display()));
    let text = fs::read_to_string(&page).unwrap().replace("&#x2f;", "/");
    assert!(text.contains("damaged/scores.jsonl, line 1, is not what a learner writes"), "{text}");
}
