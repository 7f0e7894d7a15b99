//! Which evaluators are connected, when each last reported progress, and the log lines about them.

use std::collections::{BTreeMap, BTreeSet};
use std::mem;
use std::time::{Duration, Instant};

use quad_protocol::{Name, Progress};
use serde::Serialize;

use super::metrics::EvaluatorMetrics;
use super::requests::NotAccepted;

/// The metrics of an evaluator that has left are dropped this long after its last progress message.
const FORGET_AFTER: Duration = Duration::from_secs(600);
/// Most evaluators that the learner tracks: far above any real pool. The limit bounds the memory
/// that made-up names take.
const MOST_EVALUATORS: usize = 1024;
/// So many evaluators per period get a log line of their own; the rest are one line with a number.
const ONE_BY_ONE: usize = 20;
const PERIOD: Duration = Duration::from_secs(10);

/// A connected evaluator.
#[derive(Debug, Serialize)]
pub(super) struct EvaluatorAtWork {
    pub name: String,
    /// Whether it has asked for a job, and has the run's environment.
    pub fits: bool,
    /// Time since its last progress message.
    pub seconds_ago: Option<f64>,
    pub job: Option<JobAtWork>,
}

/// Its job.
#[derive(Debug, Serialize)]
pub(super) struct JobAtWork {
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Episodes that have ended.
    pub done: u32,
    /// Episodes.
    pub episodes: usize,
}

/// The connected evaluators, and those whose last message is recent.
#[derive(Debug)]
pub(super) struct Evaluators {
    metrics: EvaluatorMetrics,
    present: BTreeSet<Name>,
    /// Whether each connected evaluator that has asked for a job has the run's environment.
    asked: BTreeMap<Name, bool>,
    last_seen: BTreeMap<Name, Instant>,
    news: News,
}

impl Evaluators {
    pub fn new(metrics: EvaluatorMetrics, now: Instant) -> Self {
        let news = News { since: now, told: 0, joined: 0, left: 0, lines: Vec::new() };
        Self {
            metrics,
            present: BTreeSet::new(),
            asked: BTreeMap::new(),
            last_seen: BTreeMap::new(),
            news,
        }
    }

    /// The number of connected evaluators.
    pub fn count(&self) -> usize {
        self.present.len()
    }

    /// Whether a connected evaluator may have the run's environment. One that has not asked for a
    /// job yet may: it may be at a long job of another run.
    pub fn any_may_fit(&self) -> bool {
        self.present.iter().any(|evaluator| self.asked.get(evaluator) != Some(&false))
    }

    /// The connected evaluators: whether each is known to have the run's environment, and when its
    /// last message came.
    pub fn present(&self) -> impl Iterator<Item = (&Name, bool, Option<Instant>)> {
        let fits = |evaluator: &Name| self.asked.get(evaluator) == Some(&true);
        let seen = |evaluator: &Name| self.last_seen.get(evaluator).copied();
        self.present.iter().map(move |evaluator| (evaluator, fits(evaluator), seen(evaluator)))
    }

    /// Records that an evaluator asked for a job, and whether it has the run's environment.
    pub fn asks(&mut self, evaluator: &Name, fits: bool) {
        if self.present.contains(evaluator) && self.asked.get(evaluator) != Some(&fits) {
            self.asked.insert(evaluator.clone(), fits);
        }
    }

    /// Records that an evaluator is connected.
    pub fn joined(&mut self, evaluator: Name) -> Result<(), NotAccepted> {
        if self.present.len() >= MOST_EVALUATORS && !self.present.contains(&evaluator) {
            return Err(NotAccepted::Crowd);
        }
        let line = format!("evaluator {evaluator} is here");
        if self.present.insert(evaluator) && !self.news.tell(line) {
            self.news.joined += 1;
        }
        self.metrics.present.set(self.present.len() as i64);
        Ok(())
    }

    /// Records that an evaluator has left; the learner took back `jobs` of its jobs.
    pub fn left(&mut self, evaluator: &Name, jobs: usize) {
        if !self.present.remove(evaluator) {
            return;
        }
        self.asked.remove(evaluator);
        self.metrics.present.set(self.present.len() as i64);
        let line = match jobs {
            0 => format!("evaluator {evaluator} has left or lost its connection"),
            _ => format!(
                "evaluator {evaluator} has left or lost its connection; its unfinished job goes to others"
            ),
        };
        if !self.news.tell(line) {
            self.news.left += 1;
        }
    }

    /// Records an evaluator's progress message.
    pub fn heard(&mut self, progress: Progress, now: Instant) -> Result<(), NotAccepted> {
        if self.last_seen.len() >= MOST_EVALUATORS
            && !self.last_seen.contains_key(&progress.evaluator)
        {
            return Err(NotAccepted::Crowd);
        }
        self.metrics.observe(&progress);
        self.last_seen.insert(progress.evaluator, now);
        Ok(())
    }

    /// Forgets evaluators that left long ago. Returns the log lines since the last call.
    pub fn tick(&mut self, now: Instant) -> Vec<String> {
        let (present, metrics) = (&self.present, &self.metrics);
        self.last_seen.retain(|evaluator, seen| {
            let keep = present.contains(evaluator) || now.duration_since(*seen) < FORGET_AFTER;
            if !keep {
                metrics.forget(evaluator);
            }
            keep
        });
        self.news.take(now)
    }
}

/// Log lines about evaluators that come and go: one for each of a few, a number for many.
#[derive(Debug)]
struct News {
    since: Instant,
    told: usize,
    joined: usize,
    left: usize,
    lines: Vec<String>,
}

impl News {
    /// Whether this one gets a line of its own.
    fn tell(&mut self, line: String) -> bool {
        self.told += 1;
        let may = self.told <= ONE_BY_ONE;
        if may {
            self.lines.push(line);
        }
        may
    }

    fn take(&mut self, now: Instant) -> Vec<String> {
        if now.duration_since(self.since) >= PERIOD {
            if self.joined + self.left > 0 {
                self.lines
                    .push(format!("{} more evaluators came and {} left", self.joined, self.left));
            }
            (self.since, self.told, self.joined, self.left) = (now, 0, 0, 0);
        }
        mem::take(&mut self.lines)
    }
}

#[cfg(test)]
mod tests;
