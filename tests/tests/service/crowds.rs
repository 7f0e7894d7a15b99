//! Many evaluators at one learner, behind a router. They are light: all that they say on the wire
//! is real, but they simulate nothing, so that hundreds fit beside the learner on one machine.

use std::process::Command;
use std::thread::sleep;
use std::time::Duration;

use quad_tests::PATIENCE;
use quad_tests::crowd::Crowd;
use quad_tests::made_up::name;
use quad_tests::router::router;
use quad_tests::setting::{ENDLESS, Setting};
use quad_tests::system::{Scratch, free_endpoint};
use tokio::runtime::Runtime;

/// With more episodes than any crowd can score while it is measured.
const BUSY: Setting =
    Setting { eval_interval: 30_000, episodes: 10_000, candidates: 1, hidden: 64, ..ENDLESS };

fn percentile(mut times: Vec<Duration>, share: f64) -> Duration {
    times.sort_unstable();
    times.get(((times.len() as f64 - 1.0) * share) as usize).copied().unwrap_or_default()
}

/// Lets so many work, with episodes of up to `episode`, for so long, at a learner that `launcher`
/// starts; gives the slowest of a hundred claims.
fn work(count: usize, episode: Duration, during: Duration, launcher: &[String]) -> Duration {
    let (scratch, endpoint, runtime) = (Scratch::new(), free_endpoint(), Runtime::new().unwrap());
    let learner = scratch.learner_through(launcher, "run", BUSY, &["--connect", &endpoint]);
    let _router = runtime.block_on(router(&endpoint));
    learner.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    let alone = learner.process.peak_memory().unwrap();
    let crowd = runtime.block_on(Crowd::connect(count, episode, &name("run"), &endpoint));
    learner.wait_for_metric("evaluators", "", |there| there == count as f64);
    learner.wait_for_scores(count);
    crowd.measured();
    sleep(during);
    let measured = crowd.measured();
    assert_eq!(
        (measured.unanswered, measured.refused),
        (0, 0),
        "questions without an answer, and refused reports"
    );
    for (kind, times) in [("claims", &measured.claims), ("reports", &measured.reports)] {
        let rate = times.len() as f64 / during.as_secs_f64();
        let [middle, p99, longest] = [0.5, 0.99, 1.0].map(|share| percentile(times.clone(), share));
        eprintln!("{rate:.0} {kind}/s, median {middle:.1?}, p99 {p99:.1?}, longest {longest:.1?}");
    }
    let (memory, scores) =
        (learner.process.peak_memory().unwrap(), learner.assert_scores_are_distinct().len());
    eprintln!(
        "memory: {} MiB alone, {} MiB with all; {scores} scores, each once",
        alone >> 20,
        memory >> 20
    );
    percentile(measured.claims, 0.99)
}

/// The only one takes a job, and then all the time in the world.
#[test]
fn slow_evaluators_are_reported_once() {
    let (scratch, runtime) = (Scratch::new(), Runtime::new().unwrap());
    let learner = scratch.learner("run", ENDLESS);
    learner.wait_for_metric("snapshots_published_total", "", |published| published > 5.0);
    let said =
        || learner.process.log().matches("the evaluators are slower than the training").count();
    assert_eq!(said(), 0, "there is none");
    let _crowd = runtime.block_on(Crowd::connect(
        1,
        Duration::from_secs(3600),
        &name("run"),
        &learner.endpoint(),
    ));
    let line =
        learner.process.wait_for_log("the evaluators are slower than the training", PATIENCE);
    assert!(line.contains(" evaluations have no score yet"), "{line}");
    let published = learner.metric("snapshots_published_total", "").unwrap();
    learner.wait_for_metric("snapshots_published_total", "", |now| now > published + 2.0);
    assert_eq!(said(), 1);
}

#[test]
fn fifty_evaluators_are_served_and_each_score_counts_once() {
    work(50, Duration::from_millis(50), Duration::from_secs(2), &[]);
}

#[test]
#[ignore = "two minutes, on two cores of its own"]
fn five_hundred_evaluators_are_served() {
    let launcher = cores();
    let slowest = work(500, Duration::from_millis(1600), Duration::from_secs(60), &launcher);
    assert!(slowest <= Duration::from_millis(100), "of a hundred claims one takes {slowest:.1?}");
}

/// Keeps these tests to the first core; gives what starts a program on the second, its own.
fn cores() -> [String; 3] {
    let me = std::process::id().to_string();
    let kept = Command::new("taskset").args(["-a", "-c", "-p", "0", &me]).status();
    assert!(kept.is_ok_and(|status| status.success()));
    ["taskset", "-c", "1"].map(str::to_owned)
}
