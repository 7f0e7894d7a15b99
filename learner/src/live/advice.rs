//! Advice for a run that waits for evaluators.

use std::path::Path;

use quad_dataset::environment;

/// Advice for a run without an evaluator that has its environment. `log` is that of an evaluator
/// which the learner has started.
pub(super) fn advice(environment: &str, endpoint: &str, log: Option<&Path>) -> String {
    match (environment::find(environment), log) {
        (Ok(_), Some(log)) => format!(
            "this learner's evaluators have not connected yet; if they do not, their log may say why: {}",
            log.display()
        ),
        (Ok(_), None) => {
            format!("no evaluator is here; start one with: evaluator serve --connect {endpoint}")
        }
        (Err(_), _) => format!(
            "no evaluator is here that has the environment {environment}; from Python: \
             quad_rl.evaluate(\"{environment}\", YOUR_ENVIRONMENT, connect=\"{endpoint}\") (docs/python.md)"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// On a busy machine evaluators take longer to start than the learner takes to train.
    #[test]
    fn the_advice_depends_on_the_environment_and_the_learners_own_evaluators() {
        let log = Some(Path::new("runs/mine/evaluator-1.log"));
        for (environment, log, expected) in [
            ("hopper", None, "start one with: evaluator serve --connect tcp/127.0.0.1:7447"),
            ("hopper", log, "may say why: runs/mine/evaluator-1.log"),
            ("my-robot", log, "quad_rl.evaluate(\"my-robot\""),
        ] {
            let advice = advice(environment, "tcp/127.0.0.1:7447", log);
            assert!(advice.contains(expected), "{advice}");
        }
    }
}
