//! Several runs, one evaluator for all of them: it waits for them, finds them again, and loses none
//! of their scores.

use std::time::Duration;

use quad_protocol::{ScoreReply, keys};
use quad_tests::crowd::Crowd;
use quad_tests::made_up::{ask, claim_eventually, client, name, scores};
use quad_tests::power::Disk;
use quad_tests::router::{router, router_without_scores};
use quad_tests::setting::{ENDLESS, SHORT, Setting};
use quad_tests::system::{Scratch, free_endpoint};
use quad_tests::{PATIENCE, eventually, http};
use tokio::task::JoinSet;

#[tokio::test(flavor = "multi_thread")]
async fn one_evaluator_serves_two_runs_in_turn_and_survives_the_routers_restart() {
    let scratch = Scratch::new();
    let endpoint = free_endpoint();
    let _evaluator = scratch.evaluator("shared", &endpoint);
    let [first, second] = ["first", "second"]
        .map(|run| scratch.learner_with(run, ENDLESS, &["--connect", &endpoint]));
    let both_scored = |count: usize| {
        first.wait_for_scores(count);
        second.wait_for_scores(count);
    };

    let session = router(&endpoint).await;
    both_scored(0);
    session.close().await.unwrap();
    drop(session);
    let before = first.scores().len().max(second.scores().len());
    let _session = router(&endpoint).await;
    both_scored(before + 2 * ENDLESS.episodes as usize);
}

#[test]
fn one_evaluator_serves_two_learners_that_listen_themselves() {
    let scratch = Scratch::new();
    let mut learners = ["first", "second"].map(|run| scratch.learner(run, SHORT));
    let [one, two] = learners.each_ref().map(|learner| learner.endpoint());
    let _evaluator = scratch.evaluator_with("shared", &["--connect", &one, "--connect", &two]);
    for learner in &mut learners {
        learner.assert_completes(PATIENCE);
    }
}

#[test]
fn an_evaluator_waits_for_its_learner_and_serves_the_next_one() {
    let scratch = Scratch::new();
    let endpoint = free_endpoint();
    let evaluator = scratch.evaluator("patient", &endpoint);
    evaluator.process.wait_for_log("waiting for a learner", PATIENCE);
    let mut first = scratch.learner_with("first", ENDLESS, &["--listen", &endpoint]);
    first.wait_for_scores(0);
    first.process.kill();
    let mut second = scratch.learner_with("second", SHORT, &["--listen", &endpoint]);
    second.assert_completes(PATIENCE);
}

#[tokio::test(flavor = "multi_thread")]
async fn scores_measured_offline_reach_the_next_incarnation() {
    let scratch = Scratch::new();
    let endpoint = free_endpoint();
    let sizes = Setting { candidates: 100, hidden: 256, ..SHORT };
    let setting = Setting { steps: 10, eval_interval: 10, episodes: 20, ..sizes };
    let session = router_without_scores(&endpoint, None).await;
    let mut first = scratch.learner_with("run", setting, &["--connect", &endpoint]);
    let evaluator = scratch.evaluator("cut-off", &endpoint);
    evaluator.process.wait_for_log("evaluating", PATIENCE);
    session.close().await.unwrap();
    drop(session);
    // It finds out that there is no answer when it has the scores.
    evaluator.process.wait_for_log("quad/run/scores", PATIENCE);
    assert!(first.scores().is_empty());
    first.process.kill();

    let _session = router(&endpoint).await;
    let mut second = scratch.learner_with("run", setting, &["--connect", &endpoint]);
    second.assert_completes(PATIENCE);
    let page = http::metrics(&evaluator.metrics()).unwrap();
    let measured = http::sum(&page, "quad_evaluator_episodes_total", "");
    assert_eq!(measured, f64::from(setting.episodes), "nothing was measured twice");
}

#[tokio::test(flavor = "multi_thread")]
async fn evaluators_behind_a_router_are_counted_as_they_come_and_leave() {
    let scratch = Scratch::new();
    let endpoint = free_endpoint();
    let _session = router(&endpoint).await;
    // Jobs of seconds, so that evaluators leave in the middle of one.
    let setting = Setting { episodes: 400, ..ENDLESS };
    let learner = scratch.learner_with("run", setting, &["--connect", &endpoint]);
    learner.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    let present = |count: f64| {
        learner.wait_for_metric("evaluators", "", |there| there == count);
    };
    // Not because they fell silent, which would take a minute.
    let given_up = || learner.process.log().matches("; its unfinished job goes to others").count();
    for _ in 0..2 {
        let (lost, before) = (learner.metric("jobs_total", "expired").unwrap(), given_up());
        let crowd = Crowd::connect(3, Duration::from_millis(400), &name("run"), &endpoint).await;
        present(3.0);
        eventually("all have jobs", PATIENCE, || (crowd.busy() == 3).then_some(()));
        drop(crowd);
        present(0.0);
        // Perhaps not three: one of them may have been done just then.
        eventually("their jobs are given up", PATIENCE, || {
            (given_up() > before && learner.metric("jobs_total", "expired")? > lost).then_some(())
        });
    }
}

/// As evaluators do that wait for long: the second report comes many times while the disk is slow
/// to take the first.
#[tokio::test(flavor = "multi_thread")]
async fn a_report_that_is_delivered_many_times_at_once_counts_once() {
    let scratch = Scratch::new();
    let slow = Disk::new(scratch.path());
    let setting = Setting { eval_interval: 5000, episodes: 40, ..ENDLESS };
    let learner =
        scratch.learner_through(&slow.launcher(), "run", setting, &["--listen", "tcp/127.0.0.1:0"]);
    let (session, run) = (client(&learner.endpoint()).await, name("run"));
    let (mut deliveries, mut episodes) = (JoinSet::new(), 0);
    let jobs = [
        (claim_eventually(&session, &run, "a").await, "a", 1),
        (claim_eventually(&session, &run, "b").await, "b", 20),
    ];
    for (job, evaluator, times) in &jobs {
        episodes += job.seeds.len();
        for _ in 0..*times {
            let (session, key) = (session.clone(), keys::scores(&run));
            let report = scores(job, evaluator);
            deliveries.spawn(async move { ask::<ScoreReply>(&session, key, &report).await });
        }
    }
    let mut counted = 0;
    for answer in deliveries.join_all().await {
        let Some(ScoreReply::Recorded { new, .. }) = answer else { panic!("{answer:?}") };
        counted += new as usize;
    }
    assert_eq!((counted, learner.assert_scores_are_distinct().len()), (episodes, episodes));
}
