//! The connected evaluators, their last progress messages, and the log lines about them.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use quad_protocol::{Name, Progress};
use serde_json::{Value, json};

use super::events::Events;
use super::metrics::Metrics;
use super::requests::NotAccepted;

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
    pub fn new(metrics: Metrics, events: Events, now: Instant) -> Self {
        Self { metrics, events, present: BTreeMap::new(), period: (now, 0) }
    }

    pub fn count(&self) -> usize {
        self.present.len()
    }

    /// True if a connected evaluator may have the run's environment. An evaluator that has not asked
    /// for a job yet may: it may be at a long job of another run.
    pub fn any_may_fit(&self) -> bool {
        self.present.values().any(|evaluator| evaluator.fits != Some(false))
    }

    /// The connected evaluators, for the page.
    pub fn to_json(&self, job_of: impl Fn(&Name) -> Option<Value>) -> Vec<Value> {
        let evaluator = |(name, Present { fits, last_seen }): (&Name, &Present)| {
            json!({
                "name": name.as_str(),
                "fits": *fits == Some(true),
                "seconds_ago": last_seen.map(|seen| seen.elapsed().as_secs_f64()),
                "job": job_of(name),
            })
        };
        self.present.iter().map(evaluator).collect()
    }

    /// Records that an evaluator asked for a job, and whether it has the run's environment.
    pub fn asked(&mut self, evaluator: &Name, fits: bool) {
        if let Some(present) = self.present.get_mut(evaluator) {
            present.fits = Some(fits);
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
        self.present.insert(evaluator, Present::default());
        self.metrics.evaluators.present.set(self.present.len() as i64);
        Ok(())
    }

    /// Records that an evaluator has left; `had_job` if the learner took a job back.
    pub fn left(&mut self, evaluator: &Name, had_job: bool) {
        if self.present.remove(evaluator).is_none() {
            return;
        }
        self.metrics.evaluators.present.set(self.present.len() as i64);
        self.metrics.evaluators.forget(evaluator);
        let job = if had_job { "; its unfinished job goes to others" } else { "" };
        self.line(format!("evaluator {evaluator} has left or lost its connection{job}"));
    }

    fn line(&mut self, text: String) {
        self.period.1 += 1;
        if self.period.1 <= MOST_LINES {
            self.events.line(text);
        }
    }

    /// Shows the progress of a connected evaluator.
    pub fn progress(&mut self, progress: &Progress, now: Instant) {
        if let Some(present) = self.present.get_mut(&progress.evaluator) {
            present.last_seen = Some(now);
            self.metrics.evaluators.observe(progress);
        }
    }

    /// Reports how many lines the period had too many.
    pub fn tick(&mut self, now: Instant) {
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
