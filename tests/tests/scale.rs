//! Many evaluators at one learner, behind a router. They are light: all that they say on the wire is real, but they simulate
//! nothing, so that hundreds fit beside the learner on one machine.
//!
//! With all tests there are a few. What docs/reliability.md says of five hundred comes from
//! `QUAD_EVALUATORS=500 cargo test --release --workspace --test scale -- --nocapture`, which prints what it measures.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use quad_protocol::Name;
use quad_tests::crowd::{Crowd, Measured, Pace};
use quad_tests::pace::{compare, on_core};
use quad_tests::router::router;
use quad_tests::system::{Learner, Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http, number};

/// More episodes than any crowd can score meanwhile.
const ENDLESS: Setting =
    Setting { steps: 100_000_000, eval_interval: 30_000, episodes: 10_000, candidates: 1, hidden: 64, seed: 3 };

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

#[test]
fn many_evaluators_are_served_and_training_does_not_notice() {
    let (count, seconds) = (number("QUAD_EVALUATORS", 50) as usize, number("QUAD_SECONDS", 2));
    let (phase, rounds) = (Duration::from_secs(seconds), number("QUAD_ROUNDS", 2) as usize);
    let (scratch, run) = (Scratch::new(), Name::new("run").unwrap());
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let learner = on_core(0, || scratch.learner_with("run", ENDLESS, &["--connect", &endpoint]));
    on_core(1, || {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let _router = runtime.block_on(router(&endpoint));
        learner.metrics();
        let alone = learner.process.peak_memory();
        let crowd = runtime.block_on(Crowd::connect(count, &run, &endpoint));
        eventually("all are there", PATIENCE, || {
            let page = http::metrics(&learner.metrics())?;
            (http::sum(&page, "quad_learner_evaluators", "") == count as f64).then_some(())
        });

        let paces = compare(&learner, rounds, phase, |loud| crowd.set(if loud { Pace::Real } else { Pace::Still }));
        let measured = crowd.measured();
        tell("at a real pace", &measured, rounds as u32 * phase);
        let share = paces[1].steps_per_second / paces[0].steps_per_second;
        eprintln!("training: {:.0} steps/s alone, {share:.3} of it meanwhile; {paces:.3?}", paces[0].steps_per_second);
        let page = http::metrics(&learner.metrics()).unwrap();
        let rejected: Vec<_> = page.lines().filter(|line| line.starts_with("quad_learner_rejected")).collect();
        assert_eq!(measured.unanswered, 0, "questions without an answer at a real pace: {rejected:?}");

        crowd.set(Pace::Instant);
        std::thread::sleep(phase);
        crowd.measured();
        let begin = Instant::now();
        std::thread::sleep(phase);
        tell("as fast as it goes", &crowd.measured(), begin.elapsed());
        crowd.set(Pace::Still);
        let memory = learner.process.peak_memory();
        eprintln!("memory: {} MiB alone, at most {} MiB with all", alone >> 20, memory >> 20);
        let scores = assert_each_once(&learner);
        eprintln!("{scores} scores, each once");
        assert!(scores > count, "they scored {scores}");
        assert!(percentile(&measured.claims, 0.99) < Duration::from_secs(1), "claims wait long");
        assert!(share > 0.5, "training is slow meanwhile");
    });
}
