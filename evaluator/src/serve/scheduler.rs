//! Chooses the next run: round-robin, with a pause after a failure.

use std::time::{Duration, Instant};

/// First and longest pause after a connected learner did not answer, or after its job failed.
const BACK_OFF: [Duration; 2] = [Duration::from_millis(250), Duration::from_secs(5)];

/// When a run is due next.
#[derive(Clone, Debug)]
pub struct Turn {
    ready_at: Instant,
    /// The pause after the next failure.
    back_off: Duration,
}

impl Turn {
    /// The state of a run that was just found: due now.
    pub fn new(now: Instant) -> Turn {
        Turn { ready_at: now, back_off: BACK_OFF[0] }
    }

    /// When the run is due.
    pub fn ready_at(&self) -> Instant {
        self.ready_at
    }

    /// The learner is back: the run is due, whatever failed before.
    pub fn wake(&mut self, now: Instant) {
        *self = Turn::new(now);
    }

    /// There may be work: the run is due, unless its last turn failed.
    pub fn nudge(&mut self, now: Instant) {
        if self.back_off == BACK_OFF[0] {
            self.ready_at = self.ready_at.min(now);
        }
    }

    /// After a turn that went well: the next turn comes when every other due run had its turn, and
    /// `pause` is over.
    pub fn done(&mut self, now: Instant, pause: Duration) {
        *self = Turn::new(now + pause);
    }

    /// After a turn that failed: each pause is longer than the last.
    pub fn failed(&mut self, now: Instant) {
        self.ready_at = now + self.back_off;
        self.back_off = (2 * self.back_off).min(BACK_OFF[1]);
    }
}

/// The run that has been due for longest; `None` if none is due.
pub fn next<'a, K>(runs: impl Iterator<Item = (K, &'a Turn)>, now: Instant) -> Option<K> {
    let ready = runs.filter(|(_, turn)| turn.ready_at <= now);
    ready.min_by_key(|(_, turn)| turn.ready_at).map(|(key, _)| key)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How the turns of a run go.
    #[derive(Clone, Copy)]
    enum Kind {
        /// Each takes a second and goes well.
        Works,
        /// Each takes five seconds without an answer.
        Silent,
        /// The learner answers at once that it has no work.
        Idle,
    }

    /// How many turns each run gets in ten minutes.
    fn turns(kinds: &[Kind]) -> Vec<u32> {
        let start = Instant::now();
        let mut now = start;
        let mut runs: Vec<_> = kinds.iter().map(|kind| (*kind, Turn::new(start), 0)).collect();
        while now - start < Duration::from_secs(600) {
            let Some(index) =
                next(runs.iter().enumerate().map(|(index, run)| (index, &run.1)), now)
            else {
                now += Duration::from_millis(10);
                continue;
            };
            let (kind, turn, count) = &mut runs[index];
            *count += 1;
            match kind {
                Kind::Works => {
                    now += Duration::from_secs(1);
                    turn.done(now, Duration::ZERO);
                }
                Kind::Silent => {
                    now += Duration::from_secs(5);
                    turn.failed(now);
                }
                Kind::Idle => turn.done(now, Duration::from_secs(1)),
            }
        }
        runs.into_iter().map(|(.., count)| count).collect()
    }

    #[test]
    fn runs_take_turns() {
        let counts = turns(&[Kind::Works, Kind::Idle, Kind::Works]);
        assert!(counts[0].abs_diff(counts[2]) <= 1 && counts[0] + counts[2] >= 600, "{counts:?}");
        assert!(counts[1] >= 150, "an idle learner is asked again: {counts:?}");
    }

    #[test]
    fn a_learner_that_does_not_answer_leaves_half_of_the_time_to_the_others() {
        let counts = turns(&[Kind::Works, Kind::Silent]);
        assert!(counts[0] >= 290 && counts[1] >= 50, "{counts:?}");
    }

    #[test]
    fn new_weights_do_not_end_the_pause_after_a_failure_but_a_new_learner_does() {
        let now = Instant::now();
        let mut turn = Turn::new(now);
        turn.done(now, Duration::from_secs(60));
        turn.nudge(now);
        assert_eq!(turn.ready_at(), now);
        turn.failed(now);
        turn.nudge(now);
        assert!(turn.ready_at() > now);
        turn.wake(now);
        assert_eq!(turn.ready_at(), now);
    }
}
