//! How long a trained run waits for evaluators.

use std::time::{Duration, Instant};

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

#[cfg(test)]
mod tests {
    use super::*;

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
