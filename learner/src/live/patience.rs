//! The wait of a trained run for evaluators.

use std::path::Path;
use std::time::{Duration, Instant};

use quad_dataset::environment;

/// After this time the learner advises the user to start an evaluator.
const ADVISE: Duration = Duration::from_secs(10);
/// After this time the run ends without its scores; the same command waits again.
const GIVE_UP: Duration = Duration::from_secs(600);

/// The time without an evaluator that could score the run, or practice for it.
#[derive(Default)]
pub(super) struct Patience {
    /// True once training is complete, which itself waits for practice as long as it takes.
    pub trained: bool,
    since: Option<Instant>,
    advised: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Verdict {
    Wait,
    /// Comes once in each period without such an evaluator.
    Advise,
    GiveUp,
}

impl Patience {
    /// From the end of training on.
    pub fn after_training() -> Self {
        Self { trained: true, ..Self::default() }
    }

    pub fn check(&mut self, any_evaluator: bool, now: Instant) -> Verdict {
        if any_evaluator {
            *self = Self { trained: self.trained, ..Self::default() };
            return Verdict::Wait;
        }
        let waited = now - *self.since.get_or_insert(now);
        if waited >= GIVE_UP && self.trained {
            return Verdict::GiveUp;
        }
        if waited < ADVISE || self.advised {
            return Verdict::Wait;
        }
        self.advised = true;
        Verdict::Advise
    }
}

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

    #[test]
    fn an_evaluator_that_comes_starts_the_time_anew() {
        use Verdict::{Advise, GiveUp, Wait};
        let (mut patience, begin) = (Patience::after_training(), Instant::now());
        let mut check = |any, seconds| patience.check(any, begin + Duration::from_secs(seconds));
        assert_eq!([0, 9, 10, 11, 599].map(|s| check(false, s)), [Wait, Wait, Advise, Wait, Wait]);
        assert_eq!(check(true, 599), Wait);
        assert_eq!([600, 610, 1199, 1200].map(|s| check(false, s)), [Wait, Advise, Wait, GiveUp]);
    }

    #[test]
    fn a_run_that_waits_for_practice_is_not_given_up() {
        let (mut patience, begin) = (Patience::default(), Instant::now());
        let mut check = |seconds| patience.check(false, begin + Duration::from_secs(seconds));
        assert_eq!(
            [0, 10, 600, 86_400].map(&mut check),
            [Verdict::Wait, Verdict::Advise, Verdict::Wait, Verdict::Wait]
        );
        patience = Patience::after_training();
        let verdicts = [86_400, 87_000]
            .map(|seconds| patience.check(false, begin + Duration::from_secs(seconds)));
        assert_eq!(verdicts, [Verdict::Wait, Verdict::GiveUp]);
    }
}
