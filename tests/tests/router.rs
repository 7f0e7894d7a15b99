//! Several runs behind one router, one evaluator for all of them.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use quad_tests::eventually;
use quad_tests::router::router;
use quad_tests::system::{Scratch, Setting, free_port};

const PATIENCE: Duration = Duration::from_secs(60);

#[tokio::test(flavor = "multi_thread")]
async fn one_evaluator_serves_two_runs_in_turn_and_survives_the_routers_restart() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let endless = Setting { steps: 100_000_000, eval_interval: 500, ..Setting::default() };
    let _evaluator = scratch.evaluator("shared", &endpoint);
    let first = scratch.learner_with("first", endless, &["--connect", &endpoint]);
    let second = scratch.learner_with("second", endless, &["--connect", &endpoint]);
    let both_scored = |count: usize| {
        eventually("both runs have new scores", PATIENCE, || {
            (first.scores().len() > count && second.scores().len() > count).then_some(())
        });
    };

    let session = router(&endpoint).await;
    both_scored(0);
    session.close().await.unwrap();
    drop(session);
    let before = first.scores().len().max(second.scores().len());
    let _session = router(&endpoint).await;
    both_scored(before + 2 * endless.episodes as usize);
}

#[test]
fn one_evaluator_serves_two_learners_that_listen_themselves() {
    let scratch = Scratch::new();
    let setting = Setting::default();
    let mut first = scratch.learner("first", setting);
    let mut second = scratch.learner("second", setting);
    let (one, two) = (first.endpoint(), second.endpoint());
    let _evaluator = scratch.evaluator_with("shared", &["--connect", &one, "--connect", &two]);
    for learner in [&mut first, &mut second] {
        let status = learner.process.wait(PATIENCE);
        assert!(status.success(), "the learner ended with {status}");
        learner.assert_complete(&setting);
    }
}
