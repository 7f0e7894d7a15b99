//! Many evaluators at one learner, behind a router. They are light: all that they say on the wire is real, but they simulate
//! nothing, so that hundreds fit beside the learner on one machine.

use std::process::Command;
use std::thread;
use std::time::Duration;

use quad_tests::crowd::{Crowd, Measured, Pace, longest_job};
use quad_tests::learner::Learner;
use quad_tests::made_up::name;
use quad_tests::router::router;
use quad_tests::setting::{ENDLESS, IDLE, Setting};
use quad_tests::system::{Scratch, free_endpoint};
use quad_tests::{PATIENCE, eventually};
use tokio::runtime::Runtime;
use zenoh::Session;

use crate::pace::{SETTLE, compare};

/// With more episodes than any crowd can score while it is measured.
const BUSY: Setting = Setting { eval_interval: 30_000, episodes: 10_000, candidates: 1, hidden: 64, ..ENDLESS };

fn percentile(times: &[Duration], share: f64) -> Duration {
    let mut times = times.to_vec();
    times.sort_unstable();
    times.get(((times.len() as f64 - 1.0) * share) as usize).copied().unwrap_or_default()
}

fn tell(what: &str, measured: &Measured, during: Duration) {
    for (kind, times) in [("claims", &measured.claims), ("reports", &measured.reports)] {
        let rate = times.len() as f64 / during.as_secs_f64();
        let [middle, p99, longest] = [0.5, 0.99, 1.0].map(|share| percentile(times, share));
        eprintln!("{what}: {rate:.0} {kind}/s, median {middle:.1?}, p99 {p99:.1?}, longest {longest:.1?}");
    }
}

/// How many evaluators there are, and for how long they are measured.
struct Size {
    count: usize,
    /// What starts the learner.
    launcher: &'static [&'static str],
    /// What the longest of their episodes takes.
    episode: Duration,
    rounds: usize,
    phase: Duration,
}

const SHORT: Size =
    Size { count: 50, launcher: &[], episode: Duration::from_millis(50), rounds: 1, phase: Duration::from_secs(2) };
/// The learner has a core of its own.
const LONG: Size = Size {
    count: 500,
    launcher: &["taskset", "-c", "1"],
    episode: Duration::from_millis(1600),
    rounds: 2,
    phase: Duration::from_secs(10),
};

/// A learner, a router, and a crowd that is connected through it.
struct Scene {
    learner: Learner,
    crowd: Crowd,
    /// The learner's memory before they came, bytes.
    alone: u64,
    _runtime: Runtime,
    _router: Session,
    _scratch: Scratch,
}

impl Scene {
    fn new(setting: Setting, size: &Size) -> Scene {
        let (scratch, endpoint) = (Scratch::new(), free_endpoint());
        let launcher: Vec<_> = size.launcher.iter().map(|&word| word.to_owned()).collect();
        let learner = scratch.learner_through(&launcher, "run", setting, &["--connect", &endpoint]);
        let runtime = Runtime::new().unwrap();
        let router = runtime.block_on(router(&endpoint));
        learner.metrics();
        let alone = learner.process.peak_memory().unwrap();
        let crowd = runtime.block_on(Crowd::connect(size.count, size.episode, &name("run"), &endpoint));
        crowd.set(Pace::Quick);
        learner.wait_for_metric("evaluators", "", |there| there == size.count as f64);
        let scene = Scene { learner, crowd, alone, _runtime: runtime, _router: router, _scratch: scratch };
        scene.pause();
        scene.crowd.measured();
        scene
    }

    /// Waits until none of them does anything.
    fn pause(&self) {
        self.crowd.set(Pace::Still);
        eventually("all have done their jobs", PATIENCE, || (self.crowd.busy() == 0).then_some(()));
    }

    /// What is measured while they work at a real pace, and training's speed meanwhile as a share of its speed alone.
    fn work(&self, size: &Size) -> (Measured, f64) {
        let mut measured = Measured::default();
        let [alone, meanwhile] = compare(&self.learner, size.rounds, size.phase, |loud| {
            if loud {
                self.crowd.set(Pace::Real);
                // Until they work in turn.
                thread::sleep(longest_job(size.episode));
                self.crowd.measured();
            } else {
                measured.add(self.crowd.measured());
                self.pause();
            }
        });
        tell("at a real pace", &measured, size.rounds as u32 * (SETTLE + size.phase));
        let share = meanwhile.steps_per_second / alone.steps_per_second;
        let threads = meanwhile.other_threads - alone.other_threads;
        let steps = alone.steps_per_second;
        eprintln!("training: {steps:.0} steps/s alone, {share:.3} of it meanwhile, {threads:.3} s/s besides");
        assert_eq!((measured.unanswered, measured.refused), (0, 0), "questions without an answer, and refused reports");
        (measured, share)
    }
}

/// Lets them work; gives the slowest of a hundred claims, and training's speed as a share of its speed alone.
fn work(size: &Size) -> (Duration, f64) {
    let scene = Scene::new(BUSY, size);
    scene.learner.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    let (measured, share) = scene.work(size);
    let memory = scene.learner.process.peak_memory().unwrap();
    let scores = scene.learner.assert_scores_are_distinct().len();
    eprintln!("memory: {} MiB alone, at most {} MiB with all", scene.alone >> 20, memory >> 20);
    eprintln!("{scores} scores, each once");
    assert!(scores > size.count, "they scored {scores}");
    (percentile(&measured.claims, 0.99), share)
}

#[test]
fn fifty_evaluators_are_served_and_each_score_counts_once() {
    work(&SHORT);
}

#[test]
#[ignore = "eight minutes, on two cores of its own"]
fn five_hundred_evaluators_are_served_and_training_hardly_notices() {
    // All but the learner runs on the other core.
    let me = std::process::id().to_string();
    assert!(Command::new("taskset").args(["-a", "-c", "-p", "0", &me]).status().is_ok_and(|status| status.success()));
    eprintln!("with nothing to do");
    let (_, idle) = Scene::new(IDLE, &LONG).work(&LONG);
    eprintln!("with more to do than they can");
    let (slowest, busy) = work(&LONG);
    assert!(slowest <= Duration::from_millis(100), "of a hundred claims one takes {slowest:.1?}");
    assert!(idle > 0.9 && busy > 0.9, "training at {idle:.3} beside idle evaluators, {busy:.3} beside busy ones");
}
