//! Which evaluators are connected, and when each last told its progress.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use quad_protocol::{Name, Progress};
use tokio::sync::mpsc::UnboundedSender;

use super::announcer::Announcer;
use super::followed::{Follow, Followed};
use super::rejection::Rejection;
use crate::metrics::EvaluatorMetrics;
use crate::notice::Notice;

/// The metrics of an evaluator that has left are dropped this long after its last progress message.
const FORGET_AFTER: Duration = Duration::from_secs(600);
/// Most evaluators that the learner tracks. No real pool is this large; the limit is for floods of made-up names.
pub(super) const MOST_EVALUATORS: usize = 1024;

/// Those that are connected, and those that were heard of not long ago.
pub(super) struct Evaluators {
    metrics: EvaluatorMetrics,
    announcer: Announcer,
    /// Those that are looked for, as soon as there is a network.
    followed: Option<Followed>,
    present: BTreeSet<Name>,
    last_seen: BTreeMap<Name, Instant>,
}

impl Evaluators {
    /// None yet.
    pub fn new(metrics: EvaluatorMetrics, notices: UnboundedSender<Notice>) -> Self {
        let announcer = Announcer::new(notices);
        Self { metrics, announcer, followed: None, present: BTreeSet::new(), last_seen: BTreeMap::new() }
    }

    /// From now on, those are seen that ask for work.
    pub fn follow(&mut self, follower: Sender<Follow>) {
        self.followed = Some(Followed::new(follower));
    }

    /// How many are connected.
    pub fn count(&self) -> usize {
        self.present.len()
    }

    /// One asked for work.
    pub fn asked(&mut self, evaluator: &Name, now: Instant) -> Result<(), Rejection> {
        self.followed.as_mut().map_or(Ok(()), |followed| followed.asked(evaluator, now))
    }

    /// One is connected.
    pub fn joined(&mut self, evaluator: Name, now: Instant) {
        if !self.followed.as_mut().is_some_and(|followed| followed.joined(&evaluator, now)) {
            return;
        }
        let is_new = self.present.insert(evaluator.clone());
        self.metrics.present.set(self.present.len() as i64);
        if is_new {
            self.announcer.joined(evaluator);
        }
    }

    /// Whether one that leaves was connected.
    pub fn remove(&mut self, evaluator: &Name) -> bool {
        if let Some(followed) = &mut self.followed {
            followed.left(evaluator);
        }
        let was_present = self.present.remove(evaluator);
        self.metrics.present.set(self.present.len() as i64);
        was_present
    }

    /// One has left; `jobs` of it were taken back.
    pub fn left(&mut self, evaluator: Name, jobs: usize) {
        self.announcer.left(evaluator, jobs);
    }

    /// One told its progress.
    pub fn heard(&mut self, progress: Progress, now: Instant) -> Result<(), Rejection> {
        if self.last_seen.len() >= MOST_EVALUATORS && !self.last_seen.contains_key(&progress.evaluator) {
            return Err(Rejection::Crowd);
        }
        self.metrics.observe(&progress);
        if let Some(followed) = &mut self.followed {
            followed.heard(&progress.evaluator, now);
        }
        self.last_seen.insert(progress.evaluator, now);
        Ok(())
    }

    /// Forgets those that are long gone, and tells of many that came or went. Gives those that must have left.
    pub fn tick(&mut self, now: Instant) -> Vec<Name> {
        self.announcer.tick(now);
        let (present, metrics) = (&self.present, &self.metrics);
        self.last_seen.retain(|evaluator, seen| {
            let keep = present.contains(evaluator) || now.duration_since(*seen) < FORGET_AFTER;
            if !keep {
                metrics.forget(evaluator);
            }
            keep
        });
        self.followed.as_mut().map(|followed| followed.tick(now)).unwrap_or_default()
    }
}
