//! The connected evaluators, their last progress messages, and the log lines about them.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use quad_protocol::{Name, Progress};
use serde_json::{Value, json};

use super::events::Events;
use super::metrics::Metrics;
use super::requests::NotAccepted;

/// The metrics of an evaluator that has left are dropped this long after its last progress message.
const FORGET_AFTER: Duration = Duration::from_secs(600);
/// Most evaluators that the learner tracks: far above any real pool. The limit bounds the memory
/// that made-up names take.
const MOST_EVALUATORS: usize = 1024;
/// Most log lines in a period about evaluators that come and go; the rest are counted.
const MOST_LINES: usize = 20;
const PERIOD: Duration = Duration::from_secs(10);

#[derive(Debug)]
pub(super) struct Evaluators {
    metrics: Metrics,
    events: Events,
    /// The connected evaluators, and whether each has the run's environment, once it has asked for
    /// a job.
    present: BTreeMap<Name, Option<bool>>,
    last_seen: BTreeMap<Name, Instant>,
    /// Start of the period, and how often an evaluator has come or gone in it.
    period: (Instant, usize),
}

impl Evaluators {
    pub fn new(metrics: Metrics, events: Events, now: Instant) -> Self {
        let (present, last_seen) = (BTreeMap::new(), BTreeMap::new());
        Self { metrics, events, present, last_seen, period: (now, 0) }
    }

    pub fn count(&self) -> usize {
        self.present.len()
    }

    /// True if a connected evaluator may have the run's environment. An evaluator that has not asked
    /// for a job yet may: it may be at a long job of another run.
    pub fn any_may_fit(&self) -> bool {
        self.present.values().any(|fits| *fits != Some(false))
    }

    /// The connected evaluators, for the page.
    pub fn to_json(&self, job_of: impl Fn(&Name) -> Option<Value>) -> Vec<Value> {
        let evaluator = |(name, fits): (&Name, &Option<bool>)| {
            json!({
                "name": name.as_str(),
                "fits": *fits == Some(true),
                "seconds_ago": self.last_seen.get(name).map(|seen| seen.elapsed().as_secs_f64()),
                "job": job_of(name),
            })
        };
        self.present.iter().map(evaluator).collect()
    }

    /// Records that an evaluator asked for a job, and whether it has the run's environment.
    pub fn asked(&mut self, evaluator: &Name, fits: bool) {
        if let Some(known) = self.present.get_mut(evaluator) {
            *known = Some(fits);
        }
    }

    pub fn joined(&mut self, evaluator: Name) -> Result<(), NotAccepted> {
        if self.present.contains_key(&evaluator) {
            return Ok(());
        }
        if self.present.len() >= MOST_EVALUATORS {
            return Err(NotAccepted::Crowd);
        }
        self.line(format!("evaluator {evaluator} is here"));
        self.present.insert(evaluator, None);
        self.metrics.evaluators.present.set(self.present.len() as i64);
        Ok(())
    }

    /// Records that an evaluator has left; `had_job` if the learner took a job back.
    pub fn left(&mut self, evaluator: &Name, had_job: bool) {
        if self.present.remove(evaluator).is_none() {
            return;
        }
        self.metrics.evaluators.present.set(self.present.len() as i64);
        let job = if had_job { "; its unfinished job goes to others" } else { "" };
        self.line(format!("evaluator {evaluator} has left or lost its connection{job}"));
    }

    fn line(&mut self, text: String) {
        self.period.1 += 1;
        if self.period.1 <= MOST_LINES {
            self.events.line(text);
        }
    }

    pub fn progress(&mut self, progress: Progress, now: Instant) -> Result<(), NotAccepted> {
        let is_known = self.last_seen.contains_key(&progress.evaluator);
        if self.last_seen.len() >= MOST_EVALUATORS && !is_known {
            return Err(NotAccepted::Crowd);
        }
        self.metrics.evaluators.observe(&progress);
        self.last_seen.insert(progress.evaluator, now);
        Ok(())
    }

    /// Forgets evaluators that left long ago, and reports how many lines the period had too many.
    pub fn tick(&mut self, now: Instant) {
        self.last_seen.retain(|evaluator, seen| {
            let is_recent = now.duration_since(*seen) < FORGET_AFTER;
            let keep = is_recent || self.present.contains_key(evaluator);
            if !keep {
                self.metrics.evaluators.forget(evaluator);
            }
            keep
        });
        let (since, lines) = self.period;
        if now.duration_since(since) >= PERIOD {
            if lines > MOST_LINES {
                let more = lines - MOST_LINES;
                self.events.line(format!("evaluators came or left {more} more times"));
            }
            self.period = (now, 0);
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::sync::mpsc::unbounded_channel;

    use super::super::events::Event;
    use super::*;

    fn name(number: usize) -> Name {
        Name::new(format!("e-{number}")).unwrap()
    }

    #[test]
    fn floods_of_evaluators_are_bounded_in_number_and_in_lines() {
        let (metrics, _) = Metrics::new(&Name::new("run").unwrap(), 1, &[]).unwrap();
        let ((tx, mut rx), now) = (unbounded_channel(), Instant::now());
        let mut lines = || Vec::from_iter(std::iter::from_fn(|| rx.try_recv().ok()));
        let mut evaluators = Evaluators::new(metrics, Events(tx), now);
        for number in 0..2 * MOST_EVALUATORS {
            assert_eq!(evaluators.joined(name(number)).is_ok(), number < MOST_EVALUATORS);
        }
        for number in 0..2 * MOST_EVALUATORS {
            evaluators.left(&name(number), false);
        }
        evaluators.tick(now);
        assert_eq!(lines().len(), MOST_LINES, "the period is not over");
        evaluators.tick(now + PERIOD);
        let more = 2 * MOST_EVALUATORS - MOST_LINES;
        let expected = format!("evaluators came or left {more} more times");
        assert!(matches!(&lines()[..], [Event::Line(line)] if *line == expected));
        evaluators.joined(name(7)).unwrap();
        assert_eq!(lines().len(), 1, "a new period");
    }

    /// A trained run waits for an evaluator at a long job of another run, and not for one that can
    /// do nothing here.
    #[test]
    fn an_evaluator_may_fit_until_it_asks_for_other_work() {
        let (metrics, _) = Metrics::new(&Name::new("run").unwrap(), 1, &[]).unwrap();
        let events = Events(unbounded_channel().0);
        let mut evaluators = Evaluators::new(metrics, events, Instant::now());
        evaluators.asked(&name(1), true);
        assert!(!evaluators.any_may_fit(), "it is not connected");
        evaluators.joined(name(1)).unwrap();
        assert!(evaluators.any_may_fit(), "it has not asked");
        evaluators.asked(&name(1), false);
        assert!(!evaluators.any_may_fit());
        evaluators.joined(name(2)).unwrap();
        evaluators.asked(&name(2), true);
        assert!(evaluators.any_may_fit());
        let fits = evaluators.to_json(|_| None).into_iter().map(|shown| shown["fits"] == true);
        assert_eq!(Vec::from_iter(fits), [false, true]);
        evaluators.left(&name(2), false);
        assert!(!evaluators.any_may_fit());
    }
}
