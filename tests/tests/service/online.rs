//! Online learning: what evaluators live through comes back, and makes the same run for any number of
//! them.

use std::time::{Duration, Instant};

use quad_protocol::PieceReply;
use quad_tests::PATIENCE;
use quad_tests::crowd::Crowd;
use quad_tests::made_up::{self, name};
use quad_tests::router::router;
use quad_tests::setting::{ENDLESS, Setting};
use quad_tests::system::{Scratch, free_endpoint};
use tokio::runtime::Runtime;

const SETTING: Setting = Setting {
    steps: 100,
    eval_interval: 250,
    episodes: 2,
    candidates: 2,
    hidden: 16,
    seed: 4,
    online_steps: 1000,
};

#[test]
fn any_number_of_evaluators_makes_the_same_run() {
    let scratch = Scratch::new();
    let runs = [1, 2, 8].map(|count| {
        let mut learner = scratch.learner(&format!("of-{count}"), SETTING);
        let endpoint = learner.endpoint();
        let name = |i| format!("evaluator-{count}-{i}");
        let _evaluators =
            Vec::from_iter((0..count).map(|i| scratch.evaluator(&name(i), &endpoint)));
        learner.assert_completes(PATIENCE);
        learner
    });
    for other in &runs[1..] {
        runs[0].assert_same_as(other);
    }
}

/// An evaluator that owes an episode claims no job of the run: without an answer it never would.
#[tokio::test(flavor = "multi_thread")]
async fn an_offline_run_refuses_an_episode_of_an_earlier_run_of_its_name() {
    let scratch = Scratch::new();
    let learner = scratch.learner("run", ENDLESS);
    let (session, run) = (made_up::client(&learner.endpoint()).await, name("run"));
    let job = made_up::claim_eventually(&session, &run, "late").await;
    let answer = made_up::deliver_experience(&session, &job, "late").await;
    assert!(matches!(answer, PieceReply::Refused { .. }), "{answer:?}");
}

/// Prints the environment steps per second that a learner takes in while it trains nothing.
#[test]
#[ignore = "measures"]
fn experience_arrives_as_fast_as_it_is_written() {
    let runtime = Runtime::new().unwrap();
    for count in [1, 8, 64] {
        let (scratch, endpoint) = (Scratch::new(), free_endpoint());
        let arguments = [
            ["--connect", &endpoint],
            ["--online-steps", "100000000"],
            ["--set", "online.warmup=90000000"],
            ["--set", "online.lag=128"],
        ];
        let learner = scratch.learner_with("run", SETTING, arguments.as_flattened());
        let _router = runtime.block_on(router(&endpoint));
        let alone = learner.process.peak_memory().unwrap();
        let run = name("run");
        let crowd = runtime.block_on(Crowd::connect(count, Duration::ZERO, &run, &endpoint));
        let first = learner.wait_for_metric("experience_rows", "", |rows| rows > 10_000.0);
        let begin = Instant::now();
        let last = learner.wait_for_metric("experience_rows", "", |rows| rows > first + 100_000.0);
        let rate = (last - first) / begin.elapsed().as_secs_f64();
        let bytes = (learner.process.peak_memory().unwrap() - alone) as f64 / last;
        eprintln!("{count} evaluators: {rate:.0} steps/s, {bytes:.0} bytes of memory each");
        assert_eq!(crowd.measured().refused, 0);
    }
}
