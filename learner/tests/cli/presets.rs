//! The embedded presets beside the paper's tables, written a second time.

use quad_dataset::environment;
use toml::{Table, Value};

use crate::{learner, printed};

fn preset(name: &str) -> Table {
    printed(&["presets", name]).parse().unwrap()
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
fn each_row_of_tables_3_and_4_is_a_preset() {
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
        let rate = if name.starts_with("antmaze-large") { 1e-3 } else { 3e-4 };
        for (key, expected) in [
            ("agent.tau", Some(tau)),
            ("agent.rho", Some(rho)),
            // A threshold is what makes η learnable. It starts from 1, as DAC's does.
            ("agent.eta.threshold", threshold),
            ("agent.eta.initial", eta.or(Some(1.0))),
            ("agent.diffusion_steps", Some(5.0)),
            ("agent.critics", Some(10.0)),
            ("agent.hidden", Some(256.0)),
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
fn every_file_of_the_folder_is_listed_and_can_be_printed_or_is_a_base() {
    let list = printed(&["presets"]);
    let (tasks, bases) = list.split_once("\n\nBases of these").unwrap();
    let tasks: Vec<&str> = tasks.lines().skip(1).collect();
    let folder = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../presets")).unwrap();
    let files = folder.map(|file| file.unwrap().path().file_stem().unwrap().to_str().unwrap().to_owned());
    let mut tasks_of_the_folder = 0;
    for name in files {
        let is_task = tasks.iter().any(|line| line.starts_with(&format!("{name} ")));
        tasks_of_the_folder += usize::from(is_task);
        assert!(is_task || bases.contains(&name), "{name} is missing in\n{list}");
        assert_eq!(learner(&["presets", &name]).status.success(), is_task, "{name}");
    }
    assert_eq!((tasks_of_the_folder, tasks.len()), (22, 22));
    for row in [
        "antmaze-large-play-v0 antmaze-large-v0 antmaze-large-play-v0 paper-antmaze-large: rho 1.1, tau 1.0",
        "own-data own - data of your own: the paper's sizes, no evaluation",
    ] {
        let words = |line: &str| line.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
        assert!(tasks.iter().any(|line| words(line) == words(row)), "{row} is missing in\n{list}");
    }
}

#[test]
fn data_of_ones_own_is_not_evaluated_and_not_scaled() {
    let own = preset("own-data");
    assert_eq!((value(&own, "reward"), number(&own, "eval_interval")), (Some("as-is".into()), Some(0.0)));
}

#[test]
fn a_file_changes_its_base_and_takes_its_environments_reward_rule() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.toml");
    let path = path.to_str().unwrap();
    std::fs::write(path, "base = \"hopper-demo\"\nsteps = 7\n").unwrap();
    let mut expected = preset("hopper-demo");
    expected.insert("steps".into(), 7.into());
    assert_eq!(preset(path), expected);

    std::fs::write(path, "base = \"paper\"\nenvironment = \"my-robot\"\nagent.rho = 1.0\nagent.tau = 1.0\n").unwrap();
    let error = String::from_utf8(learner(&["presets", path]).stderr).unwrap();
    assert!(error.contains("missing field") && error.contains("hint: "), "{error}");
    let whole = std::fs::read_to_string(path).unwrap() + "agent.target_reduce = \"mean\"\nagent.eta.initial = 1.0\n";
    for (environment, rule) in [("my-robot", "as-is"), ("walker2d", "locomotion")] {
        std::fs::write(path, whole.replace("my-robot", environment)).unwrap();
        assert_eq!(value(&preset(path), "reward"), Some(rule.into()));
    }
    for (base, words) in [("hoper-demo", "did you mean hopper-demo"), ("nowhere/x.toml", "nowhere/x.toml")] {
        std::fs::write(path, format!("base = \"{base}\"\n")).unwrap();
        let error = String::from_utf8(learner(&["presets", path]).stderr).unwrap();
        assert!(error.contains(words), "{error}");
    }
}
