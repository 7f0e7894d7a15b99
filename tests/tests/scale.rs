//! Many evaluators at one learner, behind a router. They are light: all that they say on the wire is real, but they simulate
//! nothing, so that hundreds fit beside the learner on one machine.
//!
//! With all tests there are a few. What docs/reliability.md says of five hundred comes from
//! `QUAD_EVALUATORS=500 cargo test --release --workspace --test scale -- --nocapture`, which prints what it measures.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::collections::BTreeSet;
use std::thread;
use std::time::{Duration, Instant};

use quad_protocol::Name;
use quad_tests::crowd::{Crowd, Measured, Pace, longest_job};
use quad_tests::pace::{ENDLESS, SETTLE, compare, on_core};
use quad_tests::router::router;
use quad_tests::system::{Learner, Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http, number};
use tokio::runtime::Runtime;
use zenoh::Session;

/// No episodes before the test is over.
const IDLE: Setting = Setting { eval_interval: 50_000_000, ..ENDLESS };

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

fn assert_each_once(learner: &Learner) -> usize {
    let scores = learner.scores();
    let distinct: BTreeSet<_> = scores.iter().map(|score| score.key()).collect();
    assert_eq!(distinct.len(), scores.len(), "a (step, seed) has two scores");
    scores.len()
}

/// A learner on one core; on the other one a router, and a crowd that is connected through it.
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
    /// Is called on the second core.
    fn new(setting: Setting, count: usize) -> Scene {
        let (scratch, run) = (Scratch::new(), Name::new("run").unwrap());
        let endpoint = format!("tcp/127.0.0.1:{}", free_port());
        let learner = on_core(1, || scratch.learner_with("run", setting, &["--connect", &endpoint]));
        let runtime = Runtime::new().unwrap();
        let router = runtime.block_on(router(&endpoint));
        learner.metrics();
        let alone = learner.process.peak_memory().unwrap();
        let crowd = runtime.block_on(Crowd::connect(count, &run, &endpoint));
        // Behind a router, a learner sees who has asked it for work.
        crowd.set(Pace::Quick);
        eventually("all are there", PATIENCE, || {
            let page = http::metrics(&learner.metrics())?;
            (http::sum(&page, "quad_learner_evaluators", "") == count as f64).then_some(())
        });
        crowd.set(Pace::Still);
        eventually("all have done their jobs", PATIENCE, || (crowd.busy() == 0).then_some(()));
        crowd.measured();
        Scene { learner, crowd, alone, _runtime: runtime, _router: router, _scratch: scratch }
    }

    /// What is measured while they work at a real pace, and training's speed meanwhile as a share of its speed alone.
    fn work(&self, rounds: usize, phase: Duration) -> (Measured, f64) {
        let mut measured = Measured::default();
        let paces = compare(&self.learner, rounds, phase, |loud| {
            if loud {
                self.crowd.set(Pace::Real);
                // Until they work in turn.
                thread::sleep(longest_job());
                self.crowd.measured();
            } else {
                measured.add(self.crowd.measured());
                self.crowd.set(Pace::Still);
                eventually("all have done their jobs", PATIENCE, || (self.crowd.busy() == 0).then_some(()));
            }
        });
        tell("at a real pace", &measured, rounds as u32 * (SETTLE + phase));
        let [alone, meanwhile] = paces;
        let share = meanwhile.steps_per_second / alone.steps_per_second;
        let threads = meanwhile.other_threads - alone.other_threads;
        eprintln!(
            "training: {:.0} steps/s alone, {share:.3} of it meanwhile, {threads:.3} s/s besides",
            alone.steps_per_second
        );
        let page = http::metrics(&self.learner.metrics()).unwrap();
        let rejected: Vec<_> = page.lines().filter(|line| line.starts_with("quad_learner_rejected")).collect();
        assert_eq!(measured.unanswered, 0, "questions without an answer at a real pace: {rejected:?}");
        (measured, share)
    }
}

#[test]
fn many_evaluators_are_served_and_training_does_not_notice() {
    let (count, seconds) = (number("QUAD_EVALUATORS", 50) as usize, number("QUAD_SECONDS", 2));
    let (phase, rounds) = (Duration::from_secs(seconds), number("QUAD_ROUNDS", 2) as usize);
    on_core(0, || {
        eprintln!("with nothing to do");
        let (_, share) = Scene::new(IDLE, count).work(rounds, phase);
        assert!(share > 0.5, "training is slow beside {count} that wait");

        eprintln!("with more to do than they can");
        let scene = Scene::new(ENDLESS, count);
        let (measured, share) = scene.work(rounds, phase);
        let Scene { learner, crowd, alone, .. } = &scene;
        crowd.set(Pace::Instant);
        // Not for long: they could do all that there is.
        thread::sleep(SETTLE);
        crowd.measured();
        let begin = Instant::now();
        thread::sleep(phase);
        tell("as fast as it goes", &crowd.measured(), begin.elapsed());
        crowd.set(Pace::Still);
        let memory = learner.process.peak_memory().unwrap();
        eprintln!("memory: {} MiB alone, at most {} MiB with all", alone >> 20, memory >> 20);
        let scores = assert_each_once(learner);
        eprintln!("{scores} scores, each once");
        assert!(scores > count, "they scored {scores}");
        assert!(percentile(&measured.claims, 0.99) < Duration::from_secs(1), "claims wait long");
        assert!(share > 0.5, "training is slow meanwhile");
    });
}
