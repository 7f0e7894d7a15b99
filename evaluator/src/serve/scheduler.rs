//! Chooses the next run: round-robin, with a pause after a failure.

use std::time::{Duration, Instant};

/// First and longest pause after a connected learner did not answer, or after its job failed.
const BACK_OFF: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];

/// Time at which a run is due.
#[derive(Clone, Debug)]
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

    /// Counts the turns in ten minutes of runs with the seconds that a turn takes and the pause
    /// after it; `None` if a turn fails.
    fn turns<const N: usize>(runs: [(u64, Option<u64>); N]) -> [u32; N] {
        let start = Instant::now();
        let mut now = start;
        let (mut turns, mut counts) = (runs.map(|_| Turn::new(start)), [0; N]);
        while now - start < Duration::from_secs(600) {
            let Some(i) = next(turns.iter().enumerate(), now) else {
                now += Duration::from_millis(10);
                continue;
            };
            counts[i] += 1;
            now += Duration::from_secs(runs[i].0);
            match runs[i].1 {
                Some(pause) => turns[i] = Turn::new(now + Duration::from_secs(pause)),
                None => turns[i].failed(now),
            }
        }
        counts
    }

    #[test]
    fn runs_take_turns() {
        let [one, idle, other] = turns([(1, Some(0)), (0, Some(1)), (1, Some(0))]);
        assert!(one.abs_diff(other) <= 1 && one + other >= 600, "{one} {other}");
        assert!(idle >= 150, "an idle learner is asked again: {idle}");
        // A learner that does not answer leaves half of the time to the others.
        let [working, silent] = turns([(1, Some(0)), (5, None)]);
        assert!(working >= 290 && silent >= 50, "{working} {silent}");
    }

    #[test]
    fn new_weights_end_a_pause_but_not_the_one_after_a_failure() {
        let now = Instant::now();
        let mut turn = Turn::new(now + Duration::from_secs(60));
        turn.nudge(now);
        assert_eq!(turn.ready_at, now);
        turn.failed(now);
        turn.nudge(now);
        assert!(turn.ready_at > now);
    }
}
