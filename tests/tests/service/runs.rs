//! Several evaluators for a run, several runs for an evaluator, and two runs of one name.

use quad_tests::router::Router;
use quad_tests::setting::{ENDLESS, SHORT, Setting};
use quad_tests::system::Scratch;
use quad_tests::wait_until;

#[test]
fn any_number_of_evaluators_makes_the_same_online_run() {
    let scratch = Scratch::new();
    let setting = Setting { steps: 100, eval_interval: 250, online_steps: 1000, ..SHORT };
    let runs = [1, 8].map(|count| {
        let mut learner = scratch.learner(&format!("run-{count}"), setting);
        let endpoint = learner.endpoint();
        let start = |number| scratch.evaluator(&format!("evaluator-{count}-{number}"), &endpoint);
        let _evaluators = Vec::from_iter((0..count).map(start));
        learner.assert_completes();
        learner
    });
    runs[0].assert_same_as(&runs[1]);
}

#[tokio::test(flavor = "multi_thread")]
async fn one_evaluator_waits_for_two_runs_serves_both_and_survives_the_routers_death() {
    let scratch = Scratch::new();
    let mut router = Router::later();
    let evaluator = scratch.evaluator("shared", &router.endpoint);
    evaluator.wait_for_log("waiting for a learner");
    let learners = ["first", "second"]
        .map(|run| scratch.learner_with(run, ENDLESS, &["--connect", &router.endpoint]));
    for _ in 0..2 {
        router.start().await;
        for learner in &learners {
            learner.wait_for_scores(2 * ENDLESS.episodes as usize);
        }
        router.end().await;
    }
}

#[test]
fn one_evaluator_serves_two_learners_that_listen_themselves() {
    let scratch = Scratch::new();
    let mut learners = ["first", "second"].map(|run| scratch.learner(run, SHORT));
    let [one, two] = learners.each_ref().map(|learner| learner.endpoint());
    let _evaluator = scratch.evaluator_with("shared", &["--connect", &one, "--connect", &two]);
    for learner in &mut learners {
        learner.assert_completes();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn one_of_two_learners_with_one_name_stops() {
    let scratches = [Scratch::new(), Scratch::new()];
    let mut router = Router::later();
    // Both wait for the router, and so come together.
    let mut learners = scratches
        .each_ref()
        .map(|scratch| scratch.learner_with("run", ENDLESS, &["--connect", &router.endpoint]));
    for learner in &learners {
        learner.process.wait_for_log("snapshot handed to evaluation");
    }
    router.start().await;
    wait_until("one of them stops", || {
        learners.iter_mut().any(|learner| !learner.process.is_running())
    });
    let _evaluator = scratches[0].evaluator("shared", &router.endpoint);
    let [stopped, other] = &mut learners;
    let (stopped, other) =
        if stopped.process.is_running() { (other, stopped) } else { (stopped, other) };
    stopped.process.assert_said("there is another learner of run run");
    stopped.process.assert_said("hint: choose another name for the folder with --run-dir");
    other.wait_for_scores(1);
    assert!(other.process.is_running());
}
