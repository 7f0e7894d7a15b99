//! `learner report` over a folder of runs.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};

use crate::printed;
use crate::run::Run;

const TASKS: [&str; 2] = ["hopper-demo", "walker2d-demo"];

/// A complete run of five evaluations with two episodes each, whose score is their mean.
fn complete(run: Run, score: f64) -> Run {
    let numbers = [
        ("experiment.steps", 5000),
        ("experiment.eval_interval", 1000),
        ("experiment.episodes", 2),
    ];
    let mut run = run.set(&numbers.map(|(key, value)| (key, toml::Value::from(value))));
    for step in 1..=5 {
        for episode in 0..2 {
            run.score(1000 * step, episode, score + 2.0 * (step as f64 - 3.0), "00");
        }
    }
    run
}

/// QUAD with two temperatures, DAC and IQL on two tasks with five seeds, each run in a folder of
/// its own below this one.
fn write_study(folder: &Path) {
    for (task, base) in TASKS.into_iter().zip([40.0, 90.0]) {
        for seed in 0..5 {
            let quad = |key: &str, value: toml::Value| Run::new(task, seed).set(&[(key, value)]);
            let noise = [0.0, 3.0, -1.0, 2.0, -4.0][seed as usize];
            for (name, run, score) in [
                ("1", quad("experiment.agent.tau", 0.1.into()), base + noise),
                ("2", quad("experiment.agent.tau", 10.0.into()), base + 10.0 + noise / 2.0),
                ("3", quad("experiment.agent.guidance", "dac".into()), base + 0.1 - noise),
                ("4", Run::by("iql", task, seed), base + 15.0 + noise),
            ] {
                complete(run, score).write(&folder.join(task).join(name).join(seed.to_string()));
            }
        }
    }
}

fn study(folder: &Path) -> Value {
    serde_json::from_str(&printed(&["report", folder.to_str().unwrap(), "--json"])).unwrap()
}

#[test]
fn a_study_is_summed_up_over_tasks_and_seeds() {
    let folder = tempfile::tempdir().unwrap();
    write_study(folder.path());
    let report = study(folder.path());
    assert_eq!(report, study(folder.path()), "the same runs give the same intervals");
    let methods: Vec<_> =
        report["study"].as_array().unwrap().iter().map(|one| &one["method"]).collect();
    assert_eq!(methods, ["quad", "quad, agent.tau = 10.0", "dac", "iql"]);
    let first = &report["study"][0];
    assert_eq!((&first["tasks"], &first["seeds"]), (&json!(TASKS), &json!([0, 1, 2, 3, 4])));
    let near = |figure: &Value, value: f64| {
        assert!((figure.as_f64().unwrap() - value).abs() < 1e-9, "{figure} {value}")
    };
    // Ten scores: 36, 39, 40, 42, 43, 86, 89, 90, 92, 93, of which two at either end are cut.
    near(&first["iqm"]["value"], 390.0 / 6.0);
    near(&first["mean"]["value"], 65.0);
    near(&first["optimality_gap"]["value"], 0.35);
    assert!(
        first["iqm"]["low"].as_f64().unwrap() < 65.0
            && first["iqm"]["high"].as_f64().unwrap() > 65.0
    );
    let share = |at: f64| {
        first["profile"].as_array().unwrap().iter().find(|one| one["threshold"] == at).unwrap()
    };
    assert_eq!(
        [&share(0.0)["value"], &share(50.0)["value"], &share(92.0)["value"]],
        [1.0, 0.5, 0.1]
    );

    let [_, dac, iql] = &report["comparisons"].as_array().unwrap()[..] else { panic!("{report}") };
    assert_eq!((&iql["against"], &iql["pairs"]), (methods[0], &json!(10)));
    assert_eq!(
        (&iql["mean_difference"], &iql["probability_of_improvement"]["value"]),
        (&json!(15.0), &json!(1.0))
    );
    // Of 1024 ways to choose ten signs, two are as far from 0; Holm triples the smallest of three.
    near(&iql["p"], 2.0 / 1024.0);
    near(&iql["p_holm"], 6.0 / 1024.0);
    assert!(dac["p_holm"].as_f64().unwrap() > 0.5, "{dac}");
}

/// As in a study that is half done: on Walker2d there are only runs whose τ is not the task's own.
#[test]
fn a_value_that_is_not_the_tasks_own_is_named_on_every_task() {
    for hopper in [&[0.1, 0.5][..], &[0.1]] {
        let folder = tempfile::tempdir().unwrap();
        for (task, taus) in TASKS.into_iter().zip([hopper, &[0.5]]) {
            for tau in taus {
                let run = Run::new(task, 0).set(&[("experiment.agent.tau", (*tau).into())]);
                complete(run, 40.0).write(&folder.path().join(format!("{task}-{tau}")));
            }
        }
        let report = study(folder.path());
        let rows = report["study"]
            .as_array()
            .unwrap()
            .iter()
            .map(|row| (row["method"].clone(), row["tasks"].clone()));
        let with_half = &TASKS[2 - hopper.len()..];
        let expected = [
            (json!("quad"), json!([TASKS[0]])),
            (json!("quad, agent.tau = 0.5"), json!(with_half)),
        ];
        assert_eq!(Vec::from_iter(rows), expected);
    }
}

/// Two tasks of a user's own, in environments with reference returns: the report does not know
/// which τ is a task's own.
#[test]
fn values_of_a_users_own_tasks_are_named() {
    let rows = |tasks: &[(&str, &str, f64)]| {
        let folder = tempfile::tempdir().unwrap();
        for (task, environment, tau) in tasks {
            let run = Run::new("hopper-demo", 0).set(&[
                ("run.preset", (*task).into()),
                ("experiment.environment", (*environment).into()),
                ("dataset.mean_return", (*tau).into()),
                ("experiment.agent.tau", (*tau).into()),
            ]);
            complete(run, 40.0).write(&folder.path().join(task));
        }
        let report = study(folder.path());
        let rows = report["study"]
            .as_array()
            .unwrap()
            .iter()
            .map(|row| (row["method"].clone(), row["tasks"].clone()));
        Vec::from_iter(rows)
    };
    let [low, high] = ["quad, agent.tau = 0.1", "quad, agent.tau = 0.5"].map(|name| json!(name));
    let mine = rows(&[("mine-a", "hopper", 0.1), ("mine-b", "walker2d", 0.5)]);
    assert_eq!(mine, [(low, json!(["mine-a"])), (high.clone(), json!(["mine-b"]))]);
    let known = rows(&[("hopper-demo", "hopper", 0.1), ("mine", "walker2d", 0.5)]);
    assert_eq!(known, [(json!("quad"), json!(["hopper-demo"])), (high, json!(["mine"]))]);
    let alike = rows(&[("mine-a", "hopper", 0.5), ("mine-b", "walker2d", 0.5)]);
    assert_eq!(alike, [(json!("quad"), json!(["mine-a", "mine-b"]))]);
}

#[test]
fn returns_are_summed_up_task_by_task_and_a_single_seed_has_no_interval() {
    let folder = tempfile::tempdir().unwrap();
    for (name, task) in [("a", "my-robot"), ("b", "other-robot")] {
        let environment = toml::Value::from(task);
        let run = Run::new("own-data", 0)
            .set(&[("experiment.environment", environment), ("run.preset", task.into())]);
        complete(run, 50.0).write(&folder.path().join(name));
    }
    let report = study(folder.path());
    let both = report["study"].as_array().unwrap();
    assert_eq!(both.len(), 2, "{report}");
    for method in both {
        assert_eq!(
            (&method["iqm"], &method["optimality_gap"]),
            (&json!({ "value": 50.0, "low": null, "high": null }), &Value::Null)
        );
    }
    let text = printed(&["report", folder.path().to_str().unwrap()]);
    assert!(
        text.contains("No interval for quad: of a single seed in a task, the spread is not known."),
        "{text}"
    );
}

#[test]
fn figures_and_tables_come_in_the_formats_of_papers() {
    let folder = tempfile::tempdir().unwrap();
    write_study(folder.path());
    let figures = folder.path().join("figures");
    let [runs, drawn] = [folder.path(), &figures].map(|path| path.to_str().unwrap().to_owned());
    let print = |style: &str| printed(&["report", &runs, style, "--figures", &drawn]);
    let latex = print("--latex");
    assert!(
        latex.contains("\\begin{tabular}{llrrrrr}\n\\toprule\nmethod & tasks & seeds & IQM & mean"),
        "{latex}"
    );
    assert!(latex.lines().any(|line| line.starts_with("iql & 2 & 5 & 80.00 [")), "{latex}");
    for name in ["profile", "curve-hopper-demo", "curve-walker2d-demo", "tau"] {
        let [svg, png] =
            ["svg", "png"].map(|kind| fs::read(figures.join(format!("{name}.{kind}"))).unwrap());
        assert!(png.starts_with(b"\x89PNG\r\n\x1a\n") && png.len() > 10_000, "{name}");
        let svg = String::from_utf8(svg).unwrap();
        assert!(svg.starts_with("<svg") && svg.contains("<polygon"), "{name}");
        assert!(svg.contains("quad"), "{name}: {svg}");
        let label = if name.starts_with("tau") { "τ" } else { "iql" };
        assert!(svg.contains(label), "{name}: {svg}");
        // The axis of τ names whole powers of ten.
        assert!(
            !name.starts_with("tau")
                || ["0.1", "1", "10"].iter().all(|tau| svg.contains(&format!("\n{tau}\n"))),
            "{svg}"
        );
    }
}

/// What the report has of these runs, each of a task, a seed and a score, by QUAD, or by DAC if the
/// name says so.
fn report_of(runs: &[(&str, &str, u64, f64)]) -> (Value, String) {
    let folder = tempfile::tempdir().unwrap();
    for (name, task, seed, score) in runs {
        let guidance = if name.starts_with("dac") { "dac" } else { "quad" };
        let run = match *task {
            "my-robot" => Run::new("own-data", *seed).set(&[
                ("experiment.environment", "my-robot".into()),
                ("run.preset", "my-robot".into()),
            ]),
            known => Run::new(known, *seed),
        };
        complete(run.set(&[("experiment.agent.guidance", guidance.into())]), *score)
            .write(&folder.path().join(name));
    }
    (study(folder.path()), printed(&["report", folder.path().to_str().unwrap()]))
}

#[test]
fn runs_are_compared_with_those_of_their_own_seed() {
    let [task, _] = TASKS;
    let runs = [("dac-a", task, 2, 31.0), ("dac-b", task, 1, 22.0), ("dac-c", task, 3, 5.0)];
    let against = [("quad-a", task, 0, 10.0), ("quad-b", task, 1, 20.0), ("quad-c", task, 2, 30.0)];
    let (report, _) = report_of(&[against, runs].concat());
    let comparison =
        report["comparisons"].as_array().unwrap().iter().find(|one| one["p"].is_number()).unwrap();
    let of_first = if comparison["against"] == "quad" { 1.5 } else { -1.5 };
    assert_eq!(
        (&comparison["pairs"], &comparison["mean_difference"]),
        (&json!(2), &json!(of_first)),
        "{report}"
    );
}

#[test]
fn a_robot_without_reference_returns_is_in_no_mean_with_one_that_has_them() {
    let robot = "my-robot";
    let (report, _) =
        report_of(&[("a", TASKS[0], 0, 40.0), ("b", robot, 0, 900.0), ("dac", robot, 0, 950.0)]);
    let means = report["study"]
        .as_array()
        .unwrap()
        .iter()
        .map(|one| one["mean"]["value"].as_f64().unwrap());
    assert_eq!(Vec::from_iter(means), [40.0, 900.0, 950.0]);
    // Its own methods are compared with each other.
    let [comparison] = &report["comparisons"].as_array().unwrap()[..] else { panic!("{report}") };
    assert_eq!(
        (&comparison["tasks"], &comparison["mean_difference"]),
        (&json!([robot]), &json!(50.0))
    );
}

#[test]
fn a_task_of_a_single_seed_is_named_though_another_has_more() {
    let (_, text) =
        report_of(&[("a", TASKS[0], 0, 40.0), ("b", TASKS[1], 0, 50.0), ("c", TASKS[1], 1, 52.0)]);
    assert!(
        text.contains("1 to 2")
            && text.contains("No interval for quad: of a single seed in a task"),
        "{text}"
    );
}
