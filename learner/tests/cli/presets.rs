//! Values of QUAD beside the paper's tables, written a second time. How presets are listed, printed
//! and refused is in presets.trycmd.

use quad_dataset::environment;
use toml::{Table, Value};

use crate::printed;

fn preset(task: &str, algorithm: &str) -> Table {
    printed(&format!("presets {task} --algorithm {algorithm}")).parse().unwrap()
}

fn value(preset: &Table, key: &str) -> Option<Value> {
    key.split('.').try_fold(Value::Table(preset.clone()), |value, key| value.get(key).cloned())
}

fn number(preset: &Table, key: &str) -> Option<f64> {
    let value = value(preset, key)?;
    value.as_float().or(value.as_integer().map(|value| value as f64))
}

/// Task, environment, τ, b, constant η, ρ.
const TABLE_4: &str = "\
hopper-medium-v2              hopper              10.0   1.0   -     1.5
hopper-medium-replay-v2       hopper              0.1    1.0   -     1.5
hopper-medium-expert-v2       hopper              0.1    0.05  -     1.5
walker2d-medium-v2            walker2d            100.0  1.0   -     1.0
walker2d-medium-replay-v2     walker2d            100.0  1.0   -     1.0
walker2d-medium-expert-v2     walker2d            100.0  1.0   -     1.0
halfcheetah-medium-v2         halfcheetah         0.1    1.0   -     0.0
halfcheetah-medium-replay-v2  halfcheetah         1.0    1.0   -     0.0
halfcheetah-medium-expert-v2  halfcheetah         100.0  0.1   -     0.0
antmaze-umaze-v0              antmaze-umaze-v0    10.0   -     0.1   1.0
antmaze-umaze-diverse-v0      antmaze-umaze-v0    10.0   -     0.1   1.0
antmaze-medium-play-v0        antmaze-medium-v0   10.0   -     0.1   1.0
antmaze-medium-diverse-v0     antmaze-medium-v0   10.0   -     0.1   1.0
antmaze-large-play-v0         antmaze-large-v0    1.0    -     0.01  1.1
antmaze-large-diverse-v0      antmaze-large-v0    1.0    -     0.01  1.0";

#[test]
fn quad_has_the_values_of_tables_3_and_4_for_each_row() {
    for row in TABLE_4.lines() {
        let words: Vec<_> = row.split_whitespace().collect();
        let (name, environment) = (words[0], words[1]);
        let [tau, threshold, eta, rho] = [2, 3, 4, 5].map(|i| words[i].parse::<f64>().ok());
        let row = preset(name, "quad");
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
            ("agent.tau", tau),
            ("agent.rho", rho),
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
fn values_of_other_tasks_follow_from_their_nearest() {
    for algorithm in ["quad", "td3-bc", "idql"] {
        let [mut new, old] =
            ["v2", "v0"].map(|v| preset(&format!("antmaze-large-play-{v}"), algorithm));
        for key in ["environment", "dataset"] {
            new.insert(key.to_owned(), old[key].clone());
        }
        assert_eq!(new, old, "{algorithm}");
    }
    let giant = "antmaze-giant-navigate-singletask-task2-v0";
    for (algorithm, key, expected) in [
        ("quad", "agent.tau", Some(1.0)),
        ("quad", "agent.eta.initial", Some(0.01)),
        ("quad", "agent.eta.threshold", None),
        ("quad", "agent.critic_learning_rate", Some(1e-3)),
        ("quad", "steps", Some(1e6)),
        ("idql", "agent.expectile", Some(0.9)),
    ] {
        assert_eq!(number(&preset(giant, algorithm), key), expected, "{algorithm}: {key}");
    }
    let soccer = preset("antsoccer-arena-stitch-singletask-v0", "iql");
    assert_eq!(value(&soccer, "reward"), Some("subtract-1".into()));
}
