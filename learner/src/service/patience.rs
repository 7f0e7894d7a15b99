//! The wait of a trained run for evaluators.

use std::time::{Duration, Instant};

/// After this time the learner advises the user to start an evaluator.
const ADVISE: Duration = Duration::from_secs(10);
/// After this time the run ends without its scores; the same command waits again.
const GIVE_UP: Duration = Duration::from_secs(600);

/// The time without an evaluator that could score the run, or play for it.
#[derive(Debug, Default)]
pub(super) struct Patience {
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
    /// Before the run is `trained`, training waits for experience as long as it takes.
    pub fn check(&mut self, any_evaluator: bool, trained: bool, now: Instant) -> Verdict {
        if any_evaluator {
            *self = Self::default();
            return Verdict::Wait;
        }
        let waited = now - *self.since.get_or_insert(now);
        if waited >= GIVE_UP && trained {
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
    use super::Verdict::{Advise, GiveUp, Wait};
    use super::*;

    #[test]
    fn a_trained_run_gives_up_after_ten_minutes_without_an_evaluator() {
        for (trained, last) in [(true, GiveUp), (false, Wait)] {
            let (mut patience, begin) = (Patience::default(), Instant::now());
            let mut check =
                |any, seconds| patience.check(any, trained, begin + Duration::from_secs(seconds));
            let verdicts = [0, 9, 10, 11, 599].map(|seconds| check(false, seconds));
            assert_eq!(verdicts, [Wait, Wait, Advise, Wait, Wait]);
            assert_eq!(check(true, 599), Wait);
            let verdicts = [600, 610, 1199, 1200].map(|seconds| check(false, seconds));
            assert_eq!(verdicts, [Wait, Advise, Wait, last]);
        }
    }
}
