//! Processes that die, come late, come back: no score is lost, none is counted twice.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use quad_tests::router::router_without_scores;
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};

/// Jobs that take their time, so that there is a middle to be killed in on most machines.
const LONG_JOBS: Setting =
    Setting { steps: 120, eval_interval: 10, episodes: 5, candidates: 500, hidden: 256, seed: 1 };

/// Whoever is told to leave must have left within this time (docs/reliability.md).
const LONGEST_LEAVE: Duration = Duration::from_secs(10);

#[tokio::test(flavor = "multi_thread")]
async fn every_episode_is_scored_once_though_an_evaluator_is_killed_in_a_job_and_another_comes_late() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner("run", LONG_JOBS);
    let endpoint = learner.endpoint();
    let behind = format!("tcp/127.0.0.1:{}", free_port());
    let _router = router_without_scores(&behind, Some(&endpoint)).await;
    let mut victim = scratch.evaluator("victim", &behind);
    victim.process.wait_for_log("evaluating", PATIENCE);
    victim.process.kill();
    let page = || http::metrics(&learner.metrics());
    eventually("the victim's job was taken back", PATIENCE, || {
        (http::sum(&page()?, "quad_learner_jobs_total", "outcome=\"expired\"") == 1.0).then_some(())
    });
    assert!(learner.scores().is_empty());

    let scored = |name: &str| {
        let what = format!("{name} scored something");
        eventually(&what, PATIENCE, || {
            learner.scores().iter().any(|score| score.text("evaluator") == name).then_some(())
        });
    };
    let survivor = scratch.evaluator("survivor", &endpoint);
    scored("survivor");
    // Frozen, it leaves some to the other one. It cannot have done all: evaluators ask for weights four times a second at most.
    survivor.process.signal("STOP");
    let _late = scratch.evaluator("late", &endpoint);
    scored("late");
    survivor.process.signal("CONT");
    let status = learner.process.wait(PATIENCE);

    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&LONG_JOBS);
    let table = learner.process.out();
    for step in LONG_JOBS.evaluated_steps() {
        assert!(table.contains(&step.to_string()), "step {step} is not in the table:\n{table}");
    }
}

#[test]
fn an_evaluator_waits_for_its_learner_and_serves_the_next_one() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let mut evaluator = scratch.evaluator("patient", &endpoint);
    evaluator.process.wait_for_log("waiting for a learner", PATIENCE);

    let endless = Setting { steps: 100_000_000, eval_interval: 200, ..Setting::default() };
    let mut first = scratch.learner_with("first", endless, &["--listen", &endpoint]);
    eventually("the first learner has scores", PATIENCE, || (!first.scores().is_empty()).then_some(()));
    first.process.kill();

    let setting = Setting::default();
    let mut second = scratch.learner_with("second", setting, &["--listen", &endpoint]);
    let status = second.process.wait(PATIENCE);
    assert!(status.success(), "the second learner ended with {status}");
    second.assert_complete(&setting);

    let (duration, status) = evaluator.process.terminate(PATIENCE);
    assert_eq!(status.code(), Some(0), "the evaluator ended with {status}");
    assert!(duration < LONGEST_LEAVE, "it took {duration:?} to leave");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluator_leaves_in_the_middle_of_a_job() {
    let scratch = Scratch::new();
    // Nobody has to finish it, so it is as long as jobs can be.
    let learner = scratch.learner("run", Setting { episodes: 40, candidates: 1000, ..LONG_JOBS });
    let behind = format!("tcp/127.0.0.1:{}", free_port());
    let _router = router_without_scores(&behind, Some(&learner.endpoint())).await;
    let mut evaluator = scratch.evaluator("leaver", &behind);
    evaluator.process.wait_for_log("evaluating", PATIENCE);
    let (duration, status) = evaluator.process.terminate(PATIENCE);
    assert_eq!(status.code(), Some(0), "the evaluator ended with {status}");
    assert!(duration < LONGEST_LEAVE, "it took {duration:?} to leave");
    let [handed_back, expired] = eventually("the job is taken back", PATIENCE, || {
        let page = http::metrics(&learner.metrics())?;
        let jobs = |outcome| http::sum(&page, "quad_learner_jobs_total", &format!("outcome=\"{outcome}\""));
        Some(["handed_back", "expired"].map(jobs)).filter(|ended| ended.iter().sum::<f64>() > 0.0)
    });
    assert_eq!((handed_back, expired), (1.0, 0.0));
}
