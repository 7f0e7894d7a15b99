//! Tests of `config/experiment.rs`.

use super::*;
use crate::config::resolve;
use quad_runtime::one_line;
use toml::toml;

#[test]
fn changes_override_the_values_of_the_task() {
    let preset = resolve("hopper-demo", &Table::new()).unwrap();
    let resolved =
        resolve("hopper-demo", &toml! { steps = 5 agent.guidance = "none" agent.tau = 1 }).unwrap();
    assert_eq!((resolved.steps, resolved.eval_interval), (5, preset.eval_interval));
    assert_eq!(
        (&resolved.agent["guidance"], &resolved.agent["tau"]),
        (&"none".into(), &1.0.into())
    );
}

#[test]
fn demonstrations_are_short_whichever_algorithm_learns() {
    for task in crate::config::tasks::all().iter().filter(|task| task.name.ends_with("-demo")) {
        for algorithm in quad_algorithms::ALGORITHMS {
            let changes = Table::from_iter([("algorithm".to_owned(), algorithm.name.into())]);
            let steps = resolve(&task.name, &changes).unwrap().steps;
            assert!(steps <= 40_000, "{}, {}: {steps}", task.name, algorithm.name);
        }
    }
}

/// Through targets that follow at a rate, values near their fixed point as 1 − exp(−rate·(1 −
/// γ)·steps) where episodes are long.
#[test]
fn critics_arrive_at_their_values_within_a_demonstration() {
    let with_targets = quad_algorithms::ALGORITHMS
        .iter()
        .filter(|known| !["dtql", "sfbc", "diffuser"].contains(&known.name));
    for algorithm in with_targets {
        let changes = Table::from_iter([("algorithm".to_owned(), algorithm.name.into())]);
        let demonstration = resolve("hopper-demo", &changes).unwrap();
        let [rate, gamma] =
            ["ema_rate", "gamma"].map(|key| demonstration.agent[key].as_float().unwrap());
        assert!(
            rate * (1.0 - gamma) * demonstration.steps as f64 > 3.0,
            "{}: {rate}",
            algorithm.name
        );
    }
}

#[test]
fn what_cannot_be_used_is_named_with_what_can() {
    for (preset, changes, words) in [
        ("hopper-demo", toml! { tau = 3 }, "unknown field `tau`, expected one of `environment`"),
        (
            "hopper-demo",
            toml! { agent.rate = 1.0 },
            "unknown field `rate`, expected one of `actor`, `critic`",
        ),
        ("hopper-demo", toml! { agent.eta.treshold = 1.0 }, "`threshold`"),
        ("hopper-demo", toml! { agent.guidance = "sac" }, "`quad`, `dac`, `none`"),
        (
            "hopper-demo",
            toml! { agent.guidance = "constant" },
            "agent.lambda is absent, but must be given where",
        ),
        (
            "hopper-demo",
            toml! { agent.lambda = 0.5 },
            "agent.lambda is 0.5, but must be absent unless",
        ),
        (
            "hopper-demo",
            toml! { agent.guidance = "constant" agent.lambda = 2 },
            "2 is not in [0, 1]",
        ),
        ("hopper-demo", toml! { agent.samples = 0 }, "in `samples`"),
        ("hopper-demo", toml! { agent.actor.hidden = [8, 0] }, "in `actor.hidden`"),
        ("hopper-demo", toml! { algorithm = "td3" }, "no algorithm named td3"),
        ("hopper-demo", toml! { episodes = 0 }, "episodes is 0, but must be from 1 to 10000"),
        (
            "hopper-demo",
            toml! { steps = 3_000_000 eval_interval = 2 },
            "every 2 are 1500000 evaluations",
        ),
        (
            "hopper-demo",
            toml! { agent.candidates = 10_001 },
            "10001 is not a whole number from 1 to 10000",
        ),
        (
            "hopper-demo",
            toml! { algorithm = "iql" agent.candidates = 2 },
            "unknown field `candidates`",
        ),
        ("hopper-demo", toml! { algorithm = "iql" agent.tau = 2 }, "unknown field `tau`"),
        ("hoper-demo", toml! { steps = 1 }, "no task named hoper-demo"),
    ] {
        let error = one_line(&resolve(preset, &changes).unwrap_err());
        assert!(error.contains(words), "{error}");
    }
}
