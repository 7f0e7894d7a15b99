//! The wait of a trained run for evaluators.

use std::time::{Duration, Instant};

/// After this time the learner advises the user to start an evaluator.
const ADVISE: Duration = Duration::from_secs(10);
/// After this time the run ends without its scores; the same command waits again.
const GIVE_UP: Duration = Duration::from_secs(600);

/// The time without an evaluator that could score the run, or play for it.
#[derive(Debug, Default)]
pub(super) struct Patience {
    /// True once training is complete, which itself waits for experience as long as it takes.
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

#[cfg(test)]
mod tests {
    use super::*;

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
    fn a_run_that_waits_for_experience_is_not_given_up() {
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
