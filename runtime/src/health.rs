//! Whether a process still works: its parts report that they are alive, and `/healthz` names the
//! parts that have stopped.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// The parts of a process and their health. Clones are cheap and share the state.
///
/// A process without parts is healthy.
#[derive(Clone, Debug, Default)]
pub struct Health {
    parts: Arc<Mutex<Vec<Arc<Part>>>>,
}

impl Health {
    /// Adds a part of the process that will report at least every `limit` while it is alive. The
    /// part counts as alive from this call on.
    pub fn register(&self, name: impl Into<String>, limit: Duration) -> Heartbeat {
        let part = Arc::new(Part {
            name: name.into(),
            limit,
            start: Instant::now(),
            last: AtomicU64::new(0),
            state: Mutex::new(State { ending: Ending::Running, trouble: None }),
        });
        self.parts.lock().unwrap_or_else(PoisonError::into_inner).push(part.clone());
        Heartbeat { part }
    }

    /// What is wrong, one line per problem; empty if all is well.
    pub fn problems(&self) -> Vec<String> {
        self.problems_at(Instant::now())
    }

    /// Whether the part of this name should have reported that it is alive, and has not.
    pub fn is_silent(&self, name: &str) -> bool {
        let (parts, now) =
            (self.parts.lock().unwrap_or_else(PoisonError::into_inner), Instant::now());
        parts.iter().any(|part| part.name == name && part.silence(now).is_some())
    }

    fn problems_at(&self, now: Instant) -> Vec<String> {
        let parts = self.parts.lock().unwrap_or_else(PoisonError::into_inner);
        parts.iter().flat_map(|part| part.problems(now)).collect()
    }
}

/// A part's handle to report its health. If it is dropped without [`finish`](Heartbeat::finish), as by a
/// panic, the part counts as broken.
#[derive(Debug)]
pub struct Heartbeat {
    part: Arc<Part>,
}

impl Heartbeat {
    /// Reports that the part is alive. This reads the clock and stores an atomic, so a thread may
    /// call it as often as it likes.
    pub fn alive(&self) {
        self.alive_at(Instant::now());
    }

    fn alive_at(&self, now: Instant) {
        self.part.last.store((now - self.part.start).as_millis() as u64, Relaxed);
    }

    /// How often an idle part should report: several times within the limit.
    pub fn interval(&self) -> Duration {
        self.part.limit / 4
    }

    /// Reports a problem of a part that is alive, like a full disk; `None` when the problem is
    /// over.
    pub fn set_problem(&self, trouble: Option<String>) {
        self.part.state().trouble = trouble;
    }

    /// Reports that the part's work is done; it need not report again.
    pub fn finish(self) {
        self.part.state().ending = Ending::Finished;
    }
}

impl Drop for Heartbeat {
    fn drop(&mut self) {
        let mut state = self.part.state();
        if state.ending == Ending::Running {
            state.ending = Ending::Broken;
        }
    }
}

#[derive(Debug)]
struct Part {
    name: String,
    limit: Duration,
    start: Instant,
    /// Milliseconds from `start` to the last sign of life.
    last: AtomicU64,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    ending: Ending,
    trouble: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    Running,
    Finished,
    Broken,
}

impl Part {
    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// How long a part that runs has given no sign of life, if that is too long.
    fn silence(&self, now: Instant) -> Option<Duration> {
        let silent =
            (now - self.start).saturating_sub(Duration::from_millis(self.last.load(Relaxed)));
        (self.state().ending == Ending::Running && silent > self.limit).then_some(silent)
    }

    fn problems(&self, now: Instant) -> Vec<String> {
        let silent = self.silence(now).map(|silent| {
            format!(
                "{}: no sign of life for {:.0?}, {:?} are allowed",
                self.name, silent, self.limit
            )
        });
        let State { ending, trouble } = &*self.state();
        let stopped = match ending {
            Ending::Finished => return Vec::new(),
            Ending::Broken => Some(format!("{}: it ended before its work was done", self.name)),
            Ending::Running => silent,
        };
        stopped
            .into_iter()
            .chain(trouble.iter().map(|trouble| format!("{}: {trouble}", self.name)))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: Duration = Duration::from_secs(3600);
    const SHORT: Duration = Duration::from_secs(60);

    #[test]
    fn a_part_that_falls_silent_is_named_until_it_is_back() {
        let health = Health::default();
        assert!(health.problems().is_empty(), "no parts, no problems");
        let (scores, _other) = (health.register("scores", SHORT), health.register("other", LONG));
        assert!(health.problems().is_empty());
        let later = Instant::now() + 2 * SHORT;
        let problems = health.clone().problems_at(later);
        assert!(
            problems.len() == 1 && problems[0].starts_with("scores: no sign of life for "),
            "{problems:?}"
        );
        scores.alive_at(later);
        assert!(health.problems_at(later).is_empty());
    }

    #[test]
    fn a_part_that_is_done_may_be_silent_and_one_that_broke_off_may_not() {
        let health = Health::default();
        health.register("done", SHORT).finish();
        assert!(health.problems_at(Instant::now() + 2 * SHORT).is_empty());
        let beat = health.register("training", LONG);
        let panicked = std::thread::spawn(move || {
            beat.alive();
            panic!("on purpose");
        });
        assert!(panicked.join().is_err());
        assert_eq!(health.problems(), ["training: it ended before its work was done"]);
    }

    #[test]
    fn trouble_is_told_as_long_as_it_lasts() {
        let health = Health::default();
        let beat = health.register("checkpoints", LONG);
        beat.set_problem(Some("the disk is full since 12:00".to_owned()));
        assert_eq!(health.problems(), ["checkpoints: the disk is full since 12:00"]);
        beat.set_problem(None);
        assert!(health.problems().is_empty());
    }
}
