//! Tasks and algorithms' values for them beside the paper's tables, written a second time.

use quad_dataset::environment;
use toml::{Table, Value};

use crate::{learner, printed};

fn preset(name: &str) -> Table {
    printed(&["presets", name]).parse().unwrap()
}

fn preset_of(name: &str, algorithm: &str) -> Table {
    printed(&["presets", name, "--algorithm", algorithm]).parse().unwrap()
}

fn value(preset: &Table, key: &str) -> Option<Value> {
    key.split('.').try_fold(Value::Table(preset.clone()), |value, key| value.get(key).cloned())
}

fn number(preset: &Table, key: &str) -> Option<f64> {
    let value = value(preset, key)?;
    value.as_float().or(value.as_integer().map(|value| value as f64))
}

/// Task, environment, τ, b, constant η, ρ.
type Row = (&'static str, &'static str, f64, Option<f64>, Option<f64>, f64);

const TABLE_4: [Row; 15] = [
    ("hopper-medium-v2", "hopper", 10.0, Some(1.0), None, 1.5),
    ("hopper-medium-replay-v2", "hopper", 0.1, Some(1.0), None, 1.5),
    ("hopper-medium-expert-v2", "hopper", 0.1, Some(0.05), None, 1.5),
    ("walker2d-medium-v2", "walker2d", 100.0, Some(1.0), None, 1.0),
    ("walker2d-medium-replay-v2", "walker2d", 100.0, Some(1.0), None, 1.0),
    ("walker2d-medium-expert-v2", "walker2d", 100.0, Some(1.0), None, 1.0),
    ("halfcheetah-medium-v2", "halfcheetah", 0.1, Some(1.0), None, 0.0),
    ("halfcheetah-medium-replay-v2", "halfcheetah", 1.0, Some(1.0), None, 0.0),
    ("halfcheetah-medium-expert-v2", "halfcheetah", 100.0, Some(0.1), None, 0.0),
    ("antmaze-umaze-v0", "antmaze-umaze-v0", 10.0, None, Some(0.1), 1.0),
    ("antmaze-umaze-diverse-v0", "antmaze-umaze-v0", 10.0, None, Some(0.1), 1.0),
    ("antmaze-medium-play-v0", "antmaze-medium-v0", 10.0, None, Some(0.1), 1.0),
    ("antmaze-medium-diverse-v0", "antmaze-medium-v0", 10.0, None, Some(0.1), 1.0),
    ("antmaze-large-play-v0", "antmaze-large-v0", 1.0, None, Some(0.01), 1.1),
    ("antmaze-large-diverse-v0", "antmaze-large-v0", 1.0, None, Some(0.01), 1.0),
];

#[test]
fn quad_has_the_values_of_tables_3_and_4_for_each_row() {
    for (name, environment, tau, threshold, eta, rho) in TABLE_4 {
        let row = preset(name);
        assert!(environment::find(environment).is_ok());
        let reduce = if eta.is_some() { "max" } else { "mean" };
        for (key, word) in [
            ("environment", environment),
            ("dataset", name),
            ("reward", "locomotion"),
            ("precision", "f32"),
            ("algorithm", "quad"),
            ("agent.guidance", "quad"),
            ("agent.target_reduce", reduce),
        ] {
            assert_eq!(value(&row, key), Some(word.into()), "{name}: {key}");
        }
        for network in ["actor", "critic"] {
            // B.1: three layers.
            let expected = toml::toml! { hidden = [256, 256, 256] activation = "mish" };
            assert_eq!(
                value(&row, &format!("agent.{network}")),
                Some(expected.into()),
                "{name}: {network}"
            );
        }
        let rate = if name.starts_with("antmaze-large") { 1e-3 } else { 3e-4 };
        for (key, expected) in [
            ("agent.tau", Some(tau)),
            ("agent.rho", Some(rho)),
            // A threshold is what makes η learnable. It starts from 1, as DAC's does.
            ("agent.eta.threshold", threshold),
            ("agent.eta.initial", eta.or(Some(1.0))),
            ("agent.diffusion_steps", Some(5.0)),
            ("agent.critics", Some(10.0)),
            ("agent.actor_learning_rate", Some(rate)),
            ("agent.critic_learning_rate", Some(rate)),
            ("agent.eta.rate", Some(0.001)),
            ("agent.ema_rate", Some(0.005)),
            ("agent.actor_ema_every", Some(5.0)),
            ("agent.candidates", Some(10.0)),
            ("agent.samples", Some(10.0)), // DAC's, as are the next three
            ("agent.gamma", Some(0.99)),
            ("agent.eta.minimum", Some(0.001)),
            ("agent.eta.maximum", Some(100.0)),
            ("batch_size", Some(256.0)),
            ("steps", Some(2_000_000.0)),
            ("eval_interval", Some(20_000.0)),
            ("episodes", Some(10.0)),
        ] {
            assert_eq!(number(&row, key), expected, "{name}: {key}");
        }
    }
}

#[test]
fn tasks_beside_the_papers_have_values_that_suit_them() {
    let of = |task: &str, algorithm: &str| -> Table {
        let text = printed(&["presets", task, "--algorithm", algorithm]);
        assert_eq!(
            text.contains("authors give no values"),
            algorithm != "idql" || task.contains("-singletask"),
            "{text}"
        );
        text.parse().unwrap()
    };
    for algorithm in ["quad", "td3-bc", "idql"] {
        let (mut new, old) =
            (of("antmaze-large-play-v2", algorithm), preset_of("antmaze-large-play-v0", algorithm));
        for key in ["environment", "dataset"] {
            new.insert(key.to_owned(), old[key].clone());
        }
        assert_eq!(new, old, "{algorithm}");
    }
    let giant = "antmaze-giant-navigate-singletask-task2-v0";
    for (algorithm, key, expected) in [
        ("quad", "agent.tau", 1.0),
        ("quad", "agent.eta.initial", 0.01),
        ("quad", "agent.critic_learning_rate", 1e-3),
        ("quad", "steps", 1e6),
        ("iql", "agent.gamma", 0.995),
        ("iql", "agent.expectile", 0.9),
        ("iql", "agent.temperature", 10.0),
        ("idql", "agent.expectile", 0.9),
    ] {
        assert_eq!(number(&of(giant, algorithm), key), Some(expected), "{algorithm}: {key}");
    }
    assert_eq!(value(&of(giant, "quad"), "agent.eta.threshold"), None);
    let wide = Value::from(vec![512; 4]);
    assert_eq!(value(&of(giant, "iql"), "agent.actor.hidden"), Some(wide));
    for (task, rule) in
        [(giant, "subtract-1"), ("antsoccer-arena-stitch-singletask-v0", "subtract-1")]
    {
        assert_eq!(value(&of(task, "iql"), "reward"), Some(rule.into()), "{task}");
    }
    let error = learner(&["train", "--task", "cube-single-play-singletask-task3-v0"]);
    let error = String::from_utf8(error.stderr).unwrap();
    assert!(
        error.contains("`quad-convert ogbench:cube-single-play-singletask-task3-v0 --out FILE`"),
        "{error}"
    );
}

#[test]
fn tasks_and_algorithms_are_listed_with_what_their_authors_give() {
    let list = printed(&["presets"]);
    let (tasks, algorithms) = list.split_once("\n\n").unwrap();
    let tasks: Vec<&str> = tasks.lines().skip(1).collect();
    assert_eq!(tasks.len(), 21 + 6 + 42, "{list}");
    for row in [
        "antmaze-large-play-v0 antmaze-large-v0 antmaze-large-play-v0",
        "own-data own - data of your own, without evaluation",
        "antmaze-medium-play-v2 antmaze-medium antmaze-medium-play-v2",
        "antmaze-giant-stitch-singletask-v0 antmaze-giant-singletask-v0 antmaze-giant-stitch-v0 the default of -task1 to -task5",
    ] {
        let words = |line: &str| line.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
        assert!(tasks.iter().any(|line| words(line) == words(row)), "{row} is missing in\n{list}");
    }
    let algorithms: Vec<&str> = algorithms.lines().skip(1).collect();
    for row in &algorithms {
        let name = row.split_whitespace().next().unwrap();
        let file = format!("{}/../presets/{name}.toml", env!("CARGO_MANIFEST_DIR"));
        let file: Table = std::fs::read_to_string(file).unwrap().parse().unwrap();
        assert!(row.contains(file["about"].as_str().unwrap()), "{row}");
    }
    assert!(
        algorithms[0].starts_with("quad ")
            && algorithms[0].contains(" walker2d-*-v2, antmaze-*-v0 "),
        "{list}"
    );
}

#[test]
fn a_file_changes_its_task_and_takes_its_environments_reward_rule() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.toml");
    let path = path.to_str().unwrap();
    let error = || String::from_utf8(learner(&["presets", path]).stderr).unwrap();
    std::fs::write(path, "task = \"hopper-demo\"\nsteps = 7\n").unwrap();
    let mut expected = preset("hopper-demo");
    expected.insert("steps".into(), 7.into());
    assert_eq!(preset(path), expected);

    std::fs::write(path, "task = \"hopper-demo\"\nalgorithm = \"iql\"\n").unwrap();
    assert_eq!(number(&preset(path), "agent.expectile"), Some(0.7));
    let quad: Table = printed(&["presets", path, "--algorithm", "quad"]).parse().unwrap();
    assert_eq!(quad, preset("hopper-demo"), "the command line's algorithm counts");

    for (environment, rule) in [("my-robot", "as-is"), ("walker2d", "locomotion")] {
        std::fs::write(path, format!("environment = \"{environment}\"\n")).unwrap();
        assert_eq!(value(&preset(path), "reward"), Some(rule.into()));
    }
    for (text, words) in [
        (
            "task = \"own-data\"\nscale = [\"reward\"]",
            "unknown variant `reward`, expected one of `actions`, `states`, `rewards`",
        ),
        ("steps = 1", "names neither a task nor an environment"),
        ("task = \"hoper-demo\"", "did you mean hopper-demo"),
        ("task = 3", "no task named 3"),
        ("task = \"hopper-demo\"\nalgorithm = \"qad\"", "did you mean quad"),
        ("base = \"hopper-demo\"", "names neither a task nor an environment"),
    ] {
        std::fs::write(path, text).unwrap();
        assert!(error().contains(words) && error().contains("hint: "), "{}", error());
    }
}

#[test]
fn what_algorithms_measure_is_listed() {
    let all = printed(&["presets", "--metrics"]);
    let one = printed(&["presets", "--metrics", "--algorithm", "dql"]);
    assert!(all.contains(&one) && all.len() > 2 * one.len(), "{all}");
    let row = one.lines().find(|line| line.starts_with("q_loss ")).unwrap();
    assert!(row.contains("(Diffusion-QL's Eq. 3)"), "{row}");
    assert!(!learner(&["presets", "hopper-demo", "--metrics"]).status.success(), "one of the two");
}
