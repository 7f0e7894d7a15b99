//! Tests of experiments.

use crate::config::resolve;
use quad_runtime::one_line;
use toml::Table;

#[test]
fn demonstrations_are_short() {
    for task in crate::config::tasks::all().iter().filter(|task| task.name.ends_with("-demo")) {
        for algorithm in quad_algorithms::ALGORITHMS {
            let changes = Table::from_iter([("algorithm".to_owned(), algorithm.name.into())]);
            let steps = resolve(&task.name, &changes).unwrap().steps;
            assert!(steps <= 40_000, "{}, {changes}: {steps}", task.name);
        }
    }
}

/// With target networks, values approach their fixed point as 1 − exp(−rate·(1 − γ)·steps) where
/// episodes are long.
#[test]
fn critics_converge_within_a_demonstration() {
    for algorithm in quad_algorithms::ALGORITHMS {
        if ["dtql", "sfbc", "diffuser", "diffusion-policy"].contains(&algorithm.name) {
            continue;
        }
        let changes = Table::from_iter([("algorithm".to_owned(), algorithm.name.into())]);
        let demonstration = resolve("hopper-demo", &changes).unwrap();
        let value = |key| demonstration.agent[key].as_float().unwrap();
        let steps = demonstration.total_steps() as f64;
        let progress = value("ema_rate") * (1.0 - value("gamma")) * steps;
        assert!(progress > 3.0, "{}: {progress}", algorithm.name);
    }
}

#[test]
fn gradient_steps_wait_for_each_environment_step_that_they_have_begun() {
    let online = "steps = 10
online = { steps = 9, warmup = 4, updates_per_step = 3 }";
    let experiment = resolve("own-data", &format!("algorithm = 'iql'\n{online}").parse().unwrap());
    let experiment = experiment.unwrap();
    let rows = [0, 10, 11, 13, 14, 25].map(|step| experiment.environment_steps(step));
    assert_eq!(rows, [0, 0, 5, 5, 6, 9].map(Some));
    assert_eq!(experiment.total_steps(), 25);
}

#[test]
fn errors_name_the_problem() {
    for (changes, words) in [
        ("tua = 3", "unknown field `tua`, expected one of `environment`"),
        ("steps = 1.5", "expected a whole number from 0\nin `steps`"),
        ("agent.tau = 'high'", "expected a number\nin `tau`"),
        ("agent.rate = 1.0", "unknown field `rate`, expected one of `actor`, `critic`"),
        ("agent.eta.treshold = 1.0", "`threshold`"),
        ("agent.guidance = 'sac'", "`quad`, `dac`, `none`"),
        ("agent.guidance_at = 'clean'", "`noisy` or `denoised`"),
        ("agent.guidance = 'constant'", "agent.lambda is absent, but must be given where"),
        ("agent.lambda = 0.5", "agent.lambda is 0.5, but must be absent unless"),
        ("agent = { guidance = 'constant', lambda = 2 }", "2 is not in [0, 1]"),
        ("agent.samples = 0", "in `samples`"),
        ("agent.actor.hidden = [8, 0]", "in `actor.hidden`"),
        ("algorithm = 'td3'", "no algorithm named td3"),
        ("episodes = 0", "episodes is 0, but must be from 1 to 10000"),
        (
            "steps = 3_000_000
eval_interval = 2",
            "every 2 are 1500000 evaluations",
        ),
        ("agent.candidates = 10_001", "10001 is not a whole number from 1 to 10000"),
        (
            "algorithm = 'iql'
agent.candidates = 2",
            "unknown field `candidates`",
        ),
        ("algorithm = 'rlpd'\nonline.steps = 0", "0 steps without online steps"),
        (
            "algorithm = 'iql'\nonline = { steps = 9, noise = 1.1 }",
            "online.noise is 1.1, but must be",
        ),
        (
            "algorithm = 'iql'\nonline = { steps = 9, warmup = 0, share = 0.0019 }",
            "online.share is 0.0019, but must be from 0.001953125 to 1, for a row of experience in each batch",
        ),
        (
            "algorithm = 'iql'\nonline = { steps = 9, warmup = 0, share = 50.0 }",
            "online.share is 50, but must be from 0 to 1",
        ),
        (
            "algorithm = 'iql'\nonline = { steps = 9, warmup = 0, share = 0.0 }",
            "online.share is 0, but must be from",
        ),
        ("environment = ''", "environment is \"\", but must be a name"),
        ("environment = 'a/b c'", "environment is \"a/b c\", but must be a name"),
        ("environment = \"a\\u001b\"", "environment is"),
        ("algorithm = 'sfbc'\nonline.steps = 9", "sfbc learns from a dataset alone"),
        (
            "algorithm = 'dtql'\nonline = { steps = 9, updates_per_step = 1 }",
            "dtql learns from a dataset alone",
        ),
    ] {
        let error = one_line(&resolve("hopper-demo", &changes.parse().unwrap()).unwrap_err());
        assert!(error.contains(words), "{error}");
    }
}
