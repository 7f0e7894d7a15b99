//! The embedded presets beside the paper's tables, written a second time.

use quad_dataset::{RewardRule, environment};

use super::*;
use crate::config::{ConfigError, Experiment, resolve};

fn preset(name: &str) -> Experiment {
    resolve(name, &Table::new()).unwrap()
}

fn number(table: &Table, key: &str) -> Option<f64> {
    let (_, value) = keys(table).into_iter().find(|(known, _)| known == key)?;
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
        assert_eq!((&*row.environment, row.dataset.as_deref()), (environment, Some(name)));
        assert!(environment::find(environment).is_ok());
        let rate = if name.starts_with("antmaze-large") { 1e-3 } else { 3e-4 };
        for (key, value) in [
            ("tau", Some(tau)),
            ("rho", Some(rho)),
            // A threshold is what makes η learnable. It starts from 1, as DAC's does.
            ("eta.threshold", threshold),
            ("eta.initial", eta.or(Some(1.0))),
            ("diffusion_steps", Some(5.0)),
            ("critics", Some(10.0)),
            ("hidden", Some(256.0)),
            ("actor_learning_rate", Some(rate)),
            ("critic_learning_rate", Some(rate)),
            ("eta.rate", Some(0.001)),
            ("ema_rate", Some(0.005)),
            ("actor_ema_every", Some(5.0)),
            ("samples", Some(10.0)), // DAC's, as are the next three
            ("gamma", Some(0.99)),
            ("eta.minimum", Some(0.001)),
            ("eta.maximum", Some(100.0)),
        ] {
            assert_eq!(number(&row.agent, key), value, "{name}: {key}");
        }
        let reduce = if eta.is_some() { "max" } else { "mean" };
        assert_eq!((row.agent["target_reduce"].as_str(), row.agent["guidance"].as_str()), (Some(reduce), Some("quad")));
        assert_eq!((row.batch_size, row.candidates, &*row.algorithm), (256, 10, "quad"), "{name}");
        assert_eq!((row.steps, row.eval_interval, row.episodes), (2_000_000, 20_000, 10), "{name}");
        assert_eq!(row.reward, RewardRule::Locomotion, "{name}");
    }
}

#[test]
fn every_file_is_a_preset_that_can_be_printed_and_read_again_or_a_base() {
    let files = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../presets")).unwrap();
    let mut files: Vec<_> = files.map(|file| label(file.unwrap().path().to_str().unwrap())).collect();
    let mut embedded = Vec::from_iter(names());
    files.sort();
    embedded.sort();
    assert_eq!(files, embedded);

    let listed: Vec<String> = tasks().unwrap().into_iter().map(|[name, ..]| name).collect();
    assert_eq!(listed.len(), 22);
    let folder = tempfile::tempdir().unwrap();
    for name in names() {
        if !listed.iter().any(|listed| listed == name) {
            assert!(matches!(resolve(name, &Table::new()), Err(ConfigError::Base(_))), "{name}");
            continue;
        }
        let path = folder.path().join(format!("{name}.toml"));
        std::fs::write(&path, toml::to_string(&preset(name)).unwrap()).unwrap();
        assert_eq!(preset(path.to_str().unwrap()), preset(name), "{name}");
    }
}

#[test]
fn the_list_says_what_is_special() {
    let tasks = tasks().unwrap();
    let row = |name: &str| tasks.iter().find(|row| row[0] == name).unwrap().each_ref().map(|cell| &**cell);
    let large = "antmaze-large-play-v0";
    assert_eq!(row(large), [large, "antmaze-large-v0", large, "paper-antmaze-large: rho 1.1, tau 1.0"]);
    assert_eq!(row("own-data"), ["own-data", "own", "-", "data of your own: the paper's sizes, no evaluation"]);
}

#[test]
fn data_of_ones_own_is_not_evaluated_and_not_scaled() {
    let own = preset("own-data");
    assert_eq!((own.eval_interval, own.reward, own.dataset), (0, RewardRule::AsIs, None));
}

#[test]
fn a_file_of_ones_own_changes_its_base_and_what_cannot_be_read_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.toml");
    std::fs::write(&path, "base = \"hopper-demo\"\nsteps = 7\n").unwrap();
    let path = path.to_str().unwrap();
    assert_eq!((preset(path), &*label(path)), (Experiment { steps: 7, ..preset("hopper-demo") }, "mine"));
    assert!(load("nowhere/x.toml").unwrap_err().to_string().contains("nowhere/x.toml"));
    std::fs::write(path, "base = \"hoper-demo\"\n").unwrap();
    assert!(load(path).unwrap_err().hint().unwrap().contains("did you mean hopper-demo"));
}

#[test]
fn a_difference_changes_what_it_names_and_nothing_else() {
    let mut table = toml::toml! { a = 1.5 b = [1, 2] [c] d = 1 e = "x" };
    merge(&mut table, toml::toml! { a = 2 b = [3] [c] e = "y" f = true });
    assert_eq!(table, toml::toml! { a = 2.0 b = [3] [c] d = 1 e = "y" f = true });
}

#[test]
fn assignments_are_toml_and_words_need_no_quotes() {
    assert_eq!(parse_assignment("agent.tau=0.5").unwrap(), toml::toml! { agent.tau = 0.5 });
    assert_eq!(parse_assignment("environment=my-robot").unwrap(), toml::toml! { environment = "my-robot" });
    assert_eq!(parse_assignment("dataset=a b/c=\"d\".hdf5").unwrap()["dataset"].as_str(), Some("a b/c=\"d\".hdf5"));
    assert!(parse_assignment("agent.tau").unwrap_err().contains("KEY=VALUE"));
    assert!(parse_assignment("agent tau=1").unwrap_err().contains("agent tau"));
}
