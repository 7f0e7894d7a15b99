//! Tells people which evaluators come and go: each of a few, and how many there were of many.

use std::time::{Duration, Instant};

use quad_protocol::Name;
use tokio::sync::mpsc::UnboundedSender;

use crate::notice::Notice;

/// So many are told one by one in each period, the rest as a number at its end.
const ONE_BY_ONE: usize = 20;
const PERIOD: Duration = Duration::from_secs(10);

/// State of the current period.
pub(super) struct Announcer {
    notices: UnboundedSender<Notice>,
    since: Instant,
    told: usize,
    joined: usize,
    left: usize,
}

impl Announcer {
    pub fn new(notices: UnboundedSender<Notice>) -> Self {
        Self { notices, since: Instant::now(), told: 0, joined: 0, left: 0 }
    }

    pub fn joined(&mut self, evaluator: Name) {
        match self.may_tell() {
            true => self.tell(Notice::EvaluatorJoined(evaluator)),
            false => self.joined += 1,
        }
    }

    /// `jobs` of it were taken back.
    pub fn left(&mut self, evaluator: Name, jobs: usize) {
        match self.may_tell() {
            true => self.tell(Notice::EvaluatorLeft(evaluator, jobs)),
            false => self.left += 1,
        }
    }

    /// Ends the period if it is over.
    pub fn tick(&mut self, now: Instant) {
        if now.duration_since(self.since) < PERIOD {
            return;
        }
        let (joined, left) = (self.joined, self.left);
        if joined + left > 0 {
            self.tell(Notice::EvaluatorsChanged { joined, left });
        }
        (self.since, self.told, self.joined, self.left) = (now, 0, 0, 0);
    }

    fn may_tell(&mut self) -> bool {
        self.told += 1;
        self.told <= ONE_BY_ONE
    }

    fn tell(&self, notice: Notice) {
        self.notices.send(notice).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_told_in_one_line() {
        let (notify, mut notices) = tokio::sync::mpsc::unbounded_channel();
        let mut announcer = Announcer::new(notify);
        let name = Name::new("x").unwrap();
        for _ in 0..1000 {
            announcer.joined(name.clone());
            announcer.left(name.clone(), 0);
        }
        announcer.tick(Instant::now());
        let told = std::iter::from_fn(|| notices.try_recv().ok()).count();
        assert_eq!(told, ONE_BY_ONE, "the period is not over");
        announcer.tick(Instant::now() + PERIOD);
        let summary = notices.try_recv().unwrap();
        assert!(matches!(summary, Notice::EvaluatorsChanged { joined: 990, left: 990 }), "{summary:?}");
        announcer.joined(name);
        assert!(matches!(notices.try_recv(), Ok(Notice::EvaluatorJoined(_))), "a new period");
    }
}
