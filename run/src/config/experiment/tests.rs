//! Tests of experiments.

use crate::config::{Experiment, resolve};
use quad_runtime::one_line;
use toml::{Table, toml};

#[test]
fn changes_override_the_values_of_the_task() {
    let preset = resolve("hopper-demo", &Table::new()).unwrap();
    let changes = toml! { steps = 5 agent.guidance = "none" agent.tau = 1 };
    let Experiment { steps, eval_interval, agent, .. } = resolve("hopper-demo", &changes).unwrap();
    assert_eq!((steps, eval_interval), (5, preset.eval_interval));
    assert_eq!((&agent["guidance"], &agent["tau"]), (&"none".into(), &1.0.into()));
}

#[test]
fn demonstrations_are_short() {
    for task in crate::config::tasks::all().iter().filter(|task| task.name.ends_with("-demo")) {
        for algorithm in quad_algorithms::ALGORITHMS {
            let changes = Table::from_iter([("algorithm".to_owned(), algorithm.name.into())]);
            let steps = resolve(&task.name, &changes).unwrap().steps;
            assert!(steps <= 40_000, "{}, {}: {steps}", task.name, algorithm.name);
        }
    }
}

/// With target networks, values approach their fixed point as 1 − exp(−rate·(1 − γ)·steps) where
/// episodes are long.
#[test]
fn critics_converge_within_a_demonstration() {
    let with_targets = quad_algorithms::ALGORITHMS
        .iter()
        .filter(|known| !["dtql", "sfbc", "diffuser"].contains(&known.name));
    for algorithm in with_targets {
        let changes = Table::from_iter([("algorithm".to_owned(), algorithm.name.into())]);
        let demonstration = resolve("hopper-demo", &changes).unwrap();
        let [rate, gamma] =
            ["ema_rate", "gamma"].map(|key| demonstration.agent[key].as_float().unwrap());
        let steps = demonstration.total_steps() as f64;
        assert!(rate * (1.0 - gamma) * steps > 3.0, "{}: {rate}", algorithm.name);
    }
}

#[test]
fn errors_name_the_problem() {
    let refused = |preset: &str, changes: Table, words: &str| {
        let error = one_line(&resolve(preset, &changes).unwrap_err());
        assert!(error.contains(words), "{error}");
    };
    refused("hoper-demo", toml! { steps = 1 }, "no task named hoper-demo");
    let unknown = "unknown field `tau`, expected one of `environment`";
    refused("hopper-demo", toml! { tau = 3 }, unknown);
    let unknown = "unknown field `rate`, expected one of `actor`, `critic`";
    refused("hopper-demo", toml! { agent.rate = 1.0 }, unknown);
    refused("hopper-demo", toml! { agent.eta.treshold = 1.0 }, "`threshold`");
    refused("hopper-demo", toml! { agent.guidance = "sac" }, "`quad`, `dac`, `none`");
    let absent = "agent.lambda is absent, but must be given where";
    refused("hopper-demo", toml! { agent.guidance = "constant" }, absent);
    let present = "agent.lambda is 0.5, but must be absent unless";
    refused("hopper-demo", toml! { agent.lambda = 0.5 }, present);
    let constant = toml! { agent.guidance = "constant" agent.lambda = 2 };
    refused("hopper-demo", constant, "2 is not in [0, 1]");
    refused("hopper-demo", toml! { agent.samples = 0 }, "in `samples`");
    refused("hopper-demo", toml! { agent.actor.hidden = [8, 0] }, "in `actor.hidden`");
    refused("hopper-demo", toml! { algorithm = "td3" }, "no algorithm named td3");
    let range = "episodes is 0, but must be from 1 to 10000";
    refused("hopper-demo", toml! { episodes = 0 }, range);
    let many = toml! { steps = 3_000_000 eval_interval = 2 };
    refused("hopper-demo", many, "every 2 are 1500000 evaluations");
    let range = "10001 is not a whole number from 1 to 10000";
    refused("hopper-demo", toml! { agent.candidates = 10_001 }, range);
    let iql = toml! { algorithm = "iql" agent.candidates = 2 };
    refused("hopper-demo", iql, "unknown field `candidates`");
    refused("hopper-demo", toml! { steps = 0 }, "0 steps without practice");
    let without = toml! { algorithm = "rlpd" online.steps = 0 };
    refused("hopper-demo", without, "0 steps without practice");
    let of_data = toml! { algorithm = "sfbc" online.steps = 9 };
    refused("hopper-demo", of_data, "sfbc learns from a dataset alone");
}
