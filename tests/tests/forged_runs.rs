//! An evaluator among runs that nobody trains: they cost others half of its time at most, and itself a bounded log.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::{Arc, Mutex};
use std::time::Duration;

use quad_protocol::{Name, keys};
use quad_tests::router::router;
use quad_tests::system::{Learner, Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};
use zenoh::Session;
use zenoh::liveliness::LivelinessToken;

const ENDLESS: Setting =
    Setting { steps: 100_000_000, eval_interval: 500, episodes: 6, candidates: 2, hidden: 16, seed: 1 };

async fn token(session: &Session, run: &str) -> LivelinessToken {
    let run = Name::new(run).unwrap();
    session.liveliness().declare_token(keys::live_learner(&run, 1)).await.unwrap()
}

async fn scores_within(learner: &Learner, time: Duration) -> f64 {
    let before = learner.scores().len();
    tokio::time::sleep(time).await;
    (learner.scores().len() - before) as f64 / time.as_secs_f64()
}

/// Each question to one of these costs five seconds, so all of them in turn would cost most of a minute.
#[tokio::test(flavor = "multi_thread")]
async fn runs_whose_learners_never_answer_leave_others_their_time() {
    const GHOSTS: usize = 10;
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let learner = scratch.learner_with("run", ENDLESS, &["--connect", &endpoint]);
    let evaluator = scratch.evaluator("asked", &endpoint);
    eventually("there are scores", PATIENCE, || (!learner.scores().is_empty()).then_some(()));
    let alone = scores_within(&learner, Duration::from_secs(5)).await;

    // As long as a question is held, nobody knows that there will be no answer.
    let questions = Arc::new(Mutex::new(Vec::new()));
    let mut ghosts = Vec::new();
    for number in 0..GHOSTS {
        let run = format!("ghost-{number}");
        let held = questions.clone();
        let hold = move |query| held.lock().unwrap().push(query);
        let queryable = session.declare_queryable(format!("quad/{run}/**")).callback(hold).await.unwrap();
        ghosts.push((queryable, token(&session, &run).await));
    }
    eventually("all are found", PATIENCE, || {
        let page = http::metrics(&evaluator.metrics())?;
        (http::sum(&page, "quad_evaluator_runs", "") == 1.0 + GHOSTS as f64).then_some(())
    });
    // Should the learner's disk hang for so long that it is late with its thanks, the run has to wait with the ghosts for once.
    let mut among_ghosts = 0.0;
    for _ in 0..4 {
        among_ghosts = scores_within(&learner, Duration::from_secs(25)).await;
        if among_ghosts > 0.25 * alone {
            break;
        }
    }
    assert!(questions.lock().unwrap().len() >= 2, "they had their turns, too");
    assert!(among_ghosts > 0.25 * alone, "{among_ghosts:.1} scores a second, {alone:.1} without them");
}

#[tokio::test(flavor = "multi_thread")]
async fn runs_that_come_and_go_make_few_lines() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let mut evaluator = scratch.evaluator("watchful", &endpoint);
    evaluator.process.wait_for_log("connected", PATIENCE);
    for number in 0..1000 {
        drop(token(&session, &format!("short-{number}")).await);
    }
    let _last = token(&session, "last").await;
    let page = evaluator.metrics();
    eventually("all but the last have gone", PATIENCE, || {
        (http::sum(&http::metrics(&page)?, "quad_evaluator_runs", "") == 1.0).then_some(())
    });
    let log = evaluator.process.log();
    let lines = log.lines().count();
    assert!(log.contains("found a run") && lines < 600, "{lines} lines in the log");
    assert!(evaluator.process.is_running());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_that_there_is_no_room_for_takes_the_place_of_one_that_comes_to_nothing() {
    const MOST_RUNS: usize = 256;
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let evaluator = scratch.evaluator("popular", &endpoint);
    let page = evaluator.metrics();
    let sum = |metric: &str, label: &str| http::sum(&http::metrics(&page).unwrap(), metric, label);
    let mut crowd = Vec::new();
    for number in 0..MOST_RUNS {
        crowd.push(token(&session, &format!("crowd-{number}")).await);
    }
    eventually("so many are served", PATIENCE, || (sum("quad_evaluator_runs", "") == MOST_RUNS as f64).then_some(()));
    let learner = scratch.learner_with("run", ENDLESS, &["--connect", &endpoint]);
    eventually("and no more", PATIENCE, || {
        (sum("quad_evaluator_rejected_messages_total", "reason=\"too_many_runs\"") > 0.0).then_some(())
    });
    assert!(learner.scores().is_empty());
    eventually("the one that had to wait is served", PATIENCE, || (!learner.scores().is_empty()).then_some(()));
    assert_eq!(sum("quad_evaluator_runs", ""), MOST_RUNS as f64, "though all the others are still there");
}
