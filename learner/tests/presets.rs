//! The embedded presets beside the paper's tables, written a second time.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use quad_dataset::{RewardRule, environment};
use quad_learner::config::{ConfigError, Experiment, resolve};
use quad_learner::presets;
use toml::Table;

fn preset(name: &str) -> Experiment {
    resolve(name, &Table::new()).unwrap()
}

/// Every preset that can be trained.
fn tasks() -> Vec<(&'static str, Experiment)> {
    let resolved = presets::names().map(|name| (name, resolve(name, &Table::new())));
    resolved.filter_map(|(name, preset)| Some((name, preset.ok()?))).collect()
}

fn number(table: &Table, key: &str) -> Option<f64> {
    let value = key.split('.').try_fold(&toml::Value::Table(table.clone()), |value, key| value.get(key)).cloned()?;
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
fn each_row_of_table_4_is_a_preset() {
    for (name, environment, tau, threshold, eta, rho) in TABLE_4 {
        let row = preset(name);
        assert_eq!((&*row.environment, row.dataset.as_deref()), (environment, Some(name)));
        assert_eq!((number(&row.agent, "tau"), number(&row.agent, "rho")), (Some(tau), Some(rho)), "{name}");
        // A threshold is what makes η learnable. It starts from 1, as DAC's does.
        assert_eq!(number(&row.agent, "eta.threshold"), threshold, "{name}");
        assert_eq!(number(&row.agent, "eta.initial"), eta.or(Some(1.0)), "{name}");
        assert!(environment::find(environment).is_ok());

        let maze = eta.is_some();
        assert_eq!(row.agent["target_reduce"].as_str(), Some(if maze { "max" } else { "mean" }), "{name}");
        assert_eq!(row.reward, RewardRule::Locomotion, "{name}");
        assert_eq!(row.agent["guidance"].as_str(), Some("quad"), "{name}");
    }
}

#[test]
fn each_row_has_the_values_of_table_3_and_of_the_text() {
    for (name, ..) in TABLE_4 {
        let row = preset(name);
        let rate = if name.starts_with("antmaze-large") { 1e-3 } else { 3e-4 };
        for (key, value) in [
            ("diffusion_steps", 5.0),
            ("critics", 10.0),
            ("hidden", 256.0),
            ("actor_learning_rate", rate),
            ("critic_learning_rate", rate),
            ("eta.rate", 0.001),
            ("ema_rate", 0.005),
            ("actor_ema_every", 5.0),
            ("samples", 10.0), // DAC's, as are the next three
            ("gamma", 0.99),
            ("eta.minimum", 0.001),
            ("eta.maximum", 100.0),
        ] {
            assert_eq!(number(&row.agent, key), Some(value), "{name}: {key}");
        }
        assert_eq!((row.batch_size, row.candidates, &*row.algorithm), (256, 10, "quad"), "{name}");
        assert_eq!((row.steps, row.eval_interval, row.episodes), (2_000_000, 20_000, 10), "{name}");
    }
}

/// The figures in README.md are of these settings, so a change of a base must not change them.
#[test]
fn the_demonstration_stays_what_it_is() {
    let quad = toml::toml! {
        environment = "hopper"
        reward = "locomotion"
        steps = 20_000
        eval_interval = 2_000
        episodes = 10
        candidates = 10
        seed = 0
        batch_size = 256
        algorithm = "quad"
        [agent]
        hidden = 128
        critics = 5
        diffusion_steps = 5
        gamma = 0.99
        rho = 1.0
        guidance = "quad"
        tau = 0.1
        delta = 1e-6
        samples = 1
        target_reduce = "mean"
        actor_learning_rate = 1e-3
        critic_learning_rate = 1e-3
        gradient_clip = 1.0
        ema_rate = 5e-3
        nu_ema_rate = 5e-3
        actor_ema_every = 5
        actor_ema_start = 1000
        [agent.eta]
        initial = 1.0
        rate = 1e-3
        minimum = 1e-3
        maximum = 100.0
    };
    assert_eq!(preset("hopper-demo"), quad.try_into().unwrap());
    let iql = toml::toml! {
        environment = "hopper"
        reward = "locomotion"
        steps = 20_000
        eval_interval = 2_000
        episodes = 10
        candidates = 1
        seed = 0
        batch_size = 256
        algorithm = "iql"
        [agent]
        hidden = 128
        gamma = 0.99
        expectile = 0.7
        temperature = 3.0
        actor_learning_rate = 1e-3
        critic_learning_rate = 1e-3
        value_learning_rate = 1e-3
        ema_rate = 5e-3
    };
    assert_eq!(preset("hopper-demo-iql"), iql.try_into().unwrap());
}

#[test]
fn the_demonstration_elsewhere_differs_in_the_environment_alone() {
    for name in ["halfcheetah", "walker2d", "antmaze-umaze", "antmaze-medium"] {
        let mut expected = Experiment { environment: name.to_owned(), ..preset("hopper-demo") };
        if name.starts_with("antmaze") {
            expected.agent.insert("target_reduce".to_owned(), "max".into());
        }
        assert_eq!(preset(&format!("{name}-demo")), expected);
    }
}

#[test]
fn data_of_ones_own_is_not_evaluated_and_not_scaled() {
    let own = preset("own-data");
    assert_eq!((own.eval_interval, own.reward, own.dataset), (0, RewardRule::AsIs, None));
    assert!(environment::find(&own.environment).is_err());
}

#[test]
fn what_is_printed_of_a_preset_is_a_preset_and_can_be_saved_with_a_run() {
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(tasks().len(), 22);
    for (name, resolved) in tasks() {
        let path = folder.path().join(format!("{name}.toml"));
        std::fs::write(&path, toml::to_string(&resolved).unwrap()).unwrap();
        assert_eq!(preset(path.to_str().unwrap()), resolved, "{name}");
    }
}

#[test]
fn the_list_has_the_tasks_and_says_which_are_bases() {
    let list = presets::list().unwrap();
    let (tasks, bases) = list.split_once("\n\n").unwrap();
    for (name, environment, ..) in TABLE_4 {
        let words = |line: &str| line.split_whitespace().take(3).map(str::to_owned).collect::<Vec<_>>();
        assert!(tasks.lines().any(|line| words(line) == [name, environment, name]), "{name} is missing in\n{list}");
    }
    assert!(tasks.contains("paper-antmaze-large: rho 1.1, tau 1.0"), "{list}");
    for base in ["paper", "paper-locomotion", "paper-antmaze", "paper-antmaze-large"] {
        assert!(bases.contains(base) && !tasks.lines().any(|line| line.starts_with(base)), "{list}");
        assert!(matches!(resolve(base, &Table::new()), Err(ConfigError::Base(_))));
    }
}
