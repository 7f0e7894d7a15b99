//! Processes that die, come late, come back: no score is lost, none is counted twice.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};

/// Jobs of about a second, so that there is a middle to be killed in.
const LONG_JOBS: Setting =
    Setting { steps: 40, eval_interval: 10, episodes: 10, candidates: 500, hidden: 256, seed: 1 };

#[test]
fn every_episode_is_scored_once_though_an_evaluator_is_killed_in_a_job_and_another_comes_late() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner("run", LONG_JOBS);
    let endpoint = learner.endpoint();
    let mut victim = scratch.evaluator("victim", &endpoint);
    victim.process.wait_for_log("evaluating", PATIENCE);
    victim.process.kill();
    let page = || http::metrics(&learner.metrics());
    eventually("the victim's job was taken back", PATIENCE, || {
        (http::sum(&page()?, "quad_learner_jobs_total", "outcome=\"expired\"") == 1.0).then_some(())
    });

    let _survivor = scratch.evaluator("survivor", &endpoint);
    eventually("the survivor scored something", PATIENCE, || (!learner.scores().is_empty()).then_some(()));
    let _late = scratch.evaluator("late", &endpoint);
    let status = learner.process.wait(PATIENCE);

    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&LONG_JOBS);
    for name in ["survivor", "late"] {
        assert!(learner.scores().iter().any(|score| score.text("evaluator") == name), "{name} scored nothing");
    }
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
    assert!(duration < Duration::from_secs(3), "it took {duration:?} to leave");
}

#[test]
fn an_evaluator_leaves_in_the_middle_of_a_job() {
    let scratch = Scratch::new();
    let learner = scratch.learner("run", LONG_JOBS);
    let mut evaluator = scratch.evaluator("leaver", &learner.endpoint());
    evaluator.process.wait_for_log("evaluating", PATIENCE);
    let (duration, status) = evaluator.process.terminate(PATIENCE);
    assert_eq!(status.code(), Some(0), "the evaluator ended with {status}");
    assert!(duration < Duration::from_secs(3), "it took {duration:?} to leave");
    let page = http::metrics(&learner.metrics()).unwrap();
    let jobs = |outcome: &str| http::sum(&page, "quad_learner_jobs_total", &format!("outcome=\"{outcome}\""));
    assert_eq!((jobs("handed_back"), jobs("expired")), (1.0, 0.0), "{page}");
}
