//! Health of a process: its components report that they are alive, and `/healthz` names those that
//! have stopped.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Health of the components of a process. Clones share the state. A process without components is
/// healthy.
#[derive(Clone, Debug, Default)]
pub struct Health {
    components: Arc<Mutex<Vec<Arc<Component>>>>,
}

impl Health {
    /// Registers a component that will report at least every `limit`; it counts as alive now.
    pub fn register(&self, name: impl Into<String>, limit: Duration) -> Heartbeat {
        let state = State { last: Instant::now(), ending: Ending::Running, problem: None };
        let (name, state) = (name.into(), Mutex::new(state));
        let component = Component { name, limit, state };
        let component = Arc::new(component);
        lock(&self.components).push(component.clone());
        Heartbeat { component }
    }

    /// A line per problem; empty if the process is healthy.
    pub fn problems(&self) -> Vec<String> {
        self.problems_at(Instant::now())
    }

    /// True if the component of this name should have reported that it is alive, and has not.
    pub fn is_silent(&self, name: &str) -> bool {
        let now = Instant::now();
        let mut named = lock(&self.components).clone();
        named.retain(|component| component.name == name);
        named.iter().any(|component| component.silence(now).is_some())
    }

    fn problems_at(&self, now: Instant) -> Vec<String> {
        lock(&self.components).iter().flat_map(|component| component.problems(now)).collect()
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A component's handle to report its health. If it is dropped without [`finish`](Self::finish), as
/// by a panic, the component counts as broken.
#[derive(Debug)]
pub struct Heartbeat {
    component: Arc<Component>,
}

impl Heartbeat {
    /// Reports that the component is alive.
    pub fn alive(&self) {
        self.alive_at(Instant::now());
    }

    fn alive_at(&self, now: Instant) {
        lock(&self.component.state).last = now;
    }

    /// Interval at which an idle component should report.
    pub fn interval(&self) -> Duration {
        self.component.limit / 4
    }

    /// Reports a problem of a component that is alive, like a full disk; `None` once it is over.
    pub fn set_problem(&self, problem: Option<String>) {
        lock(&self.component.state).problem = problem;
    }

    /// Reports that the component's work is done; it need not report again.
    pub fn finish(self) {
        lock(&self.component.state).ending = Ending::Finished;
    }
}

impl Drop for Heartbeat {
    fn drop(&mut self) {
        let mut state = lock(&self.component.state);
        if state.ending == Ending::Running {
            state.ending = Ending::Broken;
        }
    }
}

#[derive(Debug)]
struct Component {
    name: String,
    limit: Duration,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    /// Last sign of life.
    last: Instant,
    ending: Ending,
    problem: Option<String>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    Running,
    Finished,
    Broken,
}

impl Component {
    /// Time since the last sign of life of a running component, if it is over the limit.
    fn silence(&self, now: Instant) -> Option<Duration> {
        let state = lock(&self.state);
        let silent = now.saturating_duration_since(state.last);
        (state.ending == Ending::Running && silent > self.limit).then_some(silent)
    }

    fn problems(&self, now: Instant) -> Vec<String> {
        let (name, limit, silence) = (&self.name, self.limit, self.silence(now));
        let State { ending, problem, .. } = &*lock(&self.state);
        let stopped = match ending {
            Ending::Finished => return Vec::new(),
            Ending::Broken => Some(format!("{name}: it ended before its work was done")),
            Ending::Running => silence.map(|silent| {
                format!("{name}: no sign of life for {silent:.0?}, {limit:?} are allowed")
            }),
        };
        let problem = problem.as_ref().map(|problem| format!("{name}: {problem}"));
        stopped.into_iter().chain(problem).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: Duration = Duration::from_secs(3600);
    const SHORT: Duration = Duration::from_secs(60);

    #[test]
    fn a_silent_component_is_a_problem_until_it_is_back() {
        let health = Health::default();
        let (scores, _other) = (health.register("scores", SHORT), health.register("other", LONG));
        health.register("done", SHORT).finish();
        assert!(health.problems().is_empty());
        let later = Instant::now() + 2 * SHORT;
        let problems = health.clone().problems_at(later);
        let expected = "scores: no sign of life for ";
        assert!(problems.len() == 1 && problems[0].starts_with(expected), "{problems:?}");
        scores.alive_at(later);
        assert!(health.problems_at(later).is_empty());
    }

    #[test]
    fn panics_and_reported_problems() {
        let health = Health::default();
        let heartbeat = health.register("training", LONG);
        let panicked = std::thread::spawn(move || {
            heartbeat.alive();
            panic!("on purpose");
        });
        assert!(panicked.join().is_err());
        let checkpoints = health.register("checkpoints", LONG);
        checkpoints.set_problem(Some("the disk is full".to_owned()));
        let broken = "training: it ended before its work was done";
        assert_eq!(health.problems(), [broken, "checkpoints: the disk is full"]);
        checkpoints.set_problem(None);
        assert_eq!(health.problems(), [broken]);
    }
}
