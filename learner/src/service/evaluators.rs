//! The connected evaluators, and the lines about those that come and go.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use quad_protocol::Name;

use super::message::Refusal;

/// Most evaluators that the learner tracks: far above any real pool. The limit bounds the memory
/// that made-up names take.
pub(super) const MOST_EVALUATORS: usize = 1024;
/// Most lines in a period about evaluators that come and go; the rest are counted.
const MOST_LINES: usize = 20;
const PERIOD: Duration = Duration::from_secs(10);

#[derive(Debug)]
pub(super) struct Evaluators {
    present: BTreeMap<Name, Present>,
    /// Start of the period, and how often an evaluator has come or gone in it.
    period: (Instant, usize),
}

/// A connected evaluator.
#[derive(Debug, Default)]
struct Present {
    /// True if it has the run's environment; `None` until it asks for a job.
    fits: Option<bool>,
    /// Time of its last progress message.
    last_seen: Option<Instant>,
}

impl Evaluators {
    pub fn new(now: Instant) -> Self {
        Self { present: BTreeMap::new(), period: (now, 0) }
    }

    pub fn count(&self) -> usize {
        self.present.len()
    }

    /// True if a connected evaluator may have the run's environment. An evaluator that has not asked
    /// for a job yet may: it may be at a long job of another run.
    pub fn any_may_fit(&self) -> bool {
        self.present.values().any(|evaluator| evaluator.fits != Some(false))
    }

    /// Name, whether it has the run's environment, and time of the last progress of each.
    pub fn iter(&self) -> impl Iterator<Item = (&Name, bool, Option<Instant>)> {
        let row =
            |(name, present): (_, &Present)| (name, present.fits == Some(true), present.last_seen);
        self.present.iter().map(row)
    }

    /// Records that an evaluator asked for a job, and whether it has the run's environment.
    pub fn asked(&mut self, evaluator: &Name, fits: bool) {
        if let Some(present) = self.present.get_mut(evaluator) {
            present.fits = Some(fits);
        }
    }

    /// Adds an evaluator. Returns a line about it.
    pub fn joined(&mut self, evaluator: &Name) -> Result<Option<String>, Refusal> {
        if self.present.contains_key(evaluator) {
            return Ok(None);
        }
        if self.present.len() >= MOST_EVALUATORS {
            return Err(Refusal::Crowd);
        }
        self.present.insert(evaluator.clone(), Present::default());
        Ok(self.line(format!("evaluator {evaluator} is here")))
    }

    /// Removes an evaluator, of which the learner took a job back if it `had_job`. Returns whether
    /// it was there, and a line about it.
    pub fn left(&mut self, evaluator: &Name, had_job: bool) -> (bool, Option<String>) {
        if self.present.remove(evaluator).is_none() {
            return (false, None);
        }
        let job = if had_job { "; its unfinished job goes to others" } else { "" };
        (true, self.line(format!("evaluator {evaluator} has left or lost its connection{job}")))
    }

    fn line(&mut self, text: String) -> Option<String> {
        self.period.1 += 1;
        (self.period.1 <= MOST_LINES).then_some(text)
    }

    /// Records progress. Returns whether the evaluator is connected.
    pub fn progress(&mut self, evaluator: &Name, now: Instant) -> bool {
        let present = self.present.get_mut(evaluator);
        present.map(|present| present.last_seen = Some(now)).is_some()
    }

    /// Begins a period. Returns a line if there were too many in the last.
    pub fn tick(&mut self, now: Instant) -> Option<String> {
        let (since, lines) = self.period;
        if now.duration_since(since) < PERIOD {
            return None;
        }
        self.period = (now, 0);
        let more = lines.checked_sub(MOST_LINES).filter(|more| *more > 0)?;
        Some(format!("evaluators came or left {more} more times"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(number: usize) -> Name {
        Name::new(format!("e-{number}")).unwrap()
    }

    #[test]
    fn floods_of_evaluators_are_bounded_in_number_and_in_lines() {
        let now = Instant::now();
        let mut evaluators = Evaluators::new(now);
        let mut lines = 0;
        for number in 0..2 * MOST_EVALUATORS {
            let joined = evaluators.joined(&name(number));
            assert_eq!(joined.is_ok(), number < MOST_EVALUATORS);
            lines += usize::from(joined.is_ok_and(|line| line.is_some()));
        }
        for number in 0..2 * MOST_EVALUATORS {
            lines += usize::from(evaluators.left(&name(number), false).1.is_some());
        }
        assert_eq!((lines, evaluators.tick(now)), (MOST_LINES, None), "the period is not over");
        let more = 2 * MOST_EVALUATORS - MOST_LINES;
        let expected = format!("evaluators came or left {more} more times");
        assert_eq!(evaluators.tick(now + PERIOD), Some(expected));
        assert!(evaluators.joined(&name(7)).unwrap().is_some(), "a new period");
    }

    /// A trained run waits for an evaluator at a long job of another run, and not for one that can
    /// do nothing here.
    #[test]
    fn an_evaluator_may_fit_until_it_asks_for_other_work() {
        let mut evaluators = Evaluators::new(Instant::now());
        evaluators.asked(&name(1), true);
        assert!(!evaluators.any_may_fit(), "it is not connected");
        evaluators.joined(&name(1)).unwrap();
        assert!(evaluators.any_may_fit(), "it has not asked");
        evaluators.asked(&name(1), false);
        assert!(!evaluators.any_may_fit());
        evaluators.joined(&name(2)).unwrap();
        evaluators.asked(&name(2), true);
        assert!(evaluators.any_may_fit());
        let fits = evaluators.iter().map(|(_, fits, _)| fits);
        assert_eq!(Vec::from_iter(fits), [false, true]);
        evaluators.left(&name(2), false);
        assert!(!evaluators.any_may_fit());
    }
}
