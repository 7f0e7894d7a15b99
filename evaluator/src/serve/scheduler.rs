//! Chooses the next run: round-robin, with a pause after a failure.

use std::time::{Duration, Instant};

/// First and longest pause after a connected learner did not answer, or after its job failed.
const BACK_OFF: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];

/// Time at which a run is due.
#[derive(Debug)]
pub struct Turn {
    pub ready_at: Instant,
    /// The pause after the next failure.
    back_off: Duration,
}

impl Turn {
    /// The first turn of a run or of a new learner, and each after a success. It comes after every
    /// run that is due earlier.
    pub fn new(ready_at: Instant) -> Turn {
        Turn { ready_at, back_off: BACK_OFF[0] }
    }

    /// There may be work: the run is due, unless its last turn failed.
    pub fn nudge(&mut self, now: Instant) {
        if self.back_off == BACK_OFF[0] {
            self.ready_at = self.ready_at.min(now);
        }
    }

    /// Ends a failed turn. Each pause is longer than the last.
    pub fn failed(&mut self, now: Instant) {
        self.ready_at = now + self.back_off;
        self.back_off = (2 * self.back_off).min(BACK_OFF[1]);
    }
}

/// The run that has been due for longest; `None` if none is due.
pub fn next<'a, K>(runs: impl Iterator<Item = (K, &'a Turn)>, now: Instant) -> Option<K> {
    let due = runs.filter(|(_, turn)| turn.ready_at <= now);
    due.min_by_key(|(_, turn)| turn.ready_at).map(|(key, _)| key)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_run_that_has_been_due_for_longest_is_next() {
        let now = Instant::now();
        let [early, late] = [0, 1].map(|seconds| Turn::new(now + Duration::from_secs(seconds)));
        let after = |seconds| {
            let runs = [("late", &late), ("early", &early)];
            next(runs.into_iter(), now + Duration::from_secs(seconds))
        };
        assert_eq!((after(0), after(2)), (Some("early"), Some("early")));
        assert_eq!(next([("late", &late)].into_iter(), now), None);
    }

    #[test]
    fn failures_pause_longer_each_time_and_new_weights_end_only_other_pauses() {
        let now = Instant::now();
        let mut turn = Turn::new(now + Duration::from_secs(60));
        turn.nudge(now);
        assert_eq!(turn.ready_at, now);
        for milliseconds in [250, 500, 1000, 2000, 4000, 5000, 5000] {
            turn.failed(now);
            turn.nudge(now);
            assert_eq!(turn.ready_at, now + Duration::from_millis(milliseconds));
        }
    }
}
