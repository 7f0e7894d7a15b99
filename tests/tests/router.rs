//! Several runs behind one router, one evaluator for all of them.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use quad_tests::router::router;
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};

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

#[tokio::test(flavor = "multi_thread")]
async fn scores_measured_while_cut_off_are_delivered_later() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let setting = Setting { steps: 10, eval_interval: 10, episodes: 5, candidates: 500, hidden: 256, seed: 1 };
    let session = router(&endpoint).await;
    let mut learner = scratch.learner_with("run", setting, &["--connect", &endpoint]);
    let evaluator = scratch.evaluator("cut-off", &endpoint);
    evaluator.process.wait_for_log("evaluating", PATIENCE);
    session.close().await.unwrap();
    drop(session);
    // It finds out that nobody answers when it has the scores.
    evaluator.process.wait_for_log("nobody answered", PATIENCE);
    assert!(learner.scores().is_empty());

    let _session = router(&endpoint).await;
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
    let page = http::metrics(&evaluator.metrics()).unwrap();
    let measured = http::sum(&page, "quad_evaluator_episodes_total", "");
    assert_eq!(measured, f64::from(setting.episodes), "nothing was measured twice");
}
