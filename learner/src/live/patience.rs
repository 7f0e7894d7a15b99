//! How long a trained run waits for evaluators.

use std::path::Path;
use std::time::{Duration, Instant};

use quad_dataset::environment;

/// After this time the learner says what to do.
const ADVISE: Duration = Duration::from_secs(10);
/// After this time the run ends without its scores; the same command waits again.
const GIVE_UP: Duration = Duration::from_secs(600);

/// How long no evaluator has been connected that could score the run.
#[derive(Default)]
pub(super) struct Patience {
    since: Option<Instant>,
    advised: bool,
}

/// What the main loop should do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Verdict {
    Wait,
    /// Say what to do: once in each period without such an evaluator.
    Advise,
    GiveUp,
}

impl Patience {
    /// Checks whether an evaluator is connected.
    pub fn look(&mut self, there: bool, now: Instant) -> Verdict {
        if there {
            *self = Self::default();
            return Verdict::Wait;
        }
        let waited = now - *self.since.get_or_insert(now);
        if waited >= GIVE_UP {
            return Verdict::GiveUp;
        }
        if waited < ADVISE || self.advised {
            return Verdict::Wait;
        }
        self.advised = true;
        Verdict::Advise
    }
}

/// A hint for a run without an evaluator that has its environment. `own` is the log of one that the
/// learner has started.
pub(super) fn how_to_evaluate(name: &str, endpoint: &str, own: Option<&Path>) -> String {
    match (environment::find(name), own) {
        (Ok(_), Some(log)) => {
            let log = log.display();
            format!(
                "this learner's evaluators have not connected yet; if they do not, their log may say why: {log}"
            )
        }
        (Ok(_), None) => {
            format!("no evaluator is here; start one with: evaluator serve --connect {endpoint}")
        }
        (Err(_), _) => format!(
            "no evaluator is here that has the environment {name}; from Python: \
             quad_rl.evaluate(\"{name}\", YOUR_ENVIRONMENT, connect=\"{endpoint}\") (docs/python.md)"
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// On a busy machine they take longer to start than the learner takes to train.
    #[test]
    fn who_has_started_evaluators_is_not_told_to_start_one() {
        let endpoint = "tcp/127.0.0.1:7447";
        let own = Some(Path::new("runs/mine/evaluator-1.log"));
        let [none, some] = [None, own].map(|own| how_to_evaluate("hopper", endpoint, own));
        assert!(
            none.contains("start one with: evaluator serve --connect tcp/127.0.0.1:7447"),
            "{none}"
        );
        assert!(
            !some.contains("start one") && some.contains("runs/mine/evaluator-1.log"),
            "{some}"
        );
        assert!(
            how_to_evaluate("my-robot", endpoint, own).contains("quad_rl.evaluate(\"my-robot\"")
        );
    }

    #[test]
    fn an_evaluator_that_comes_starts_the_time_anew() {
        let (mut patience, begin) = (Patience::default(), Instant::now());
        let mut look = |there, seconds| patience.look(there, begin + Duration::from_secs(seconds));
        assert_eq!([0, 9, 10, 11, 599].map(|s| look(false, s)), {
            use Verdict::{Advise, Wait};
            [Wait, Wait, Advise, Wait, Wait]
        });
        assert_eq!(look(true, 599), Verdict::Wait);
        assert_eq!([600, 610, 1199, 1200].map(|s| look(false, s)), {
            use Verdict::{Advise, GiveUp, Wait};
            [Wait, Advise, Wait, GiveUp]
        });
    }
}
