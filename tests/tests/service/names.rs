//! Two programs of one name: one of them is told.

use std::time::Duration;

use quad_tests::router::router;
use quad_tests::setting::{ENDLESS, Setting};
use quad_tests::system::{Scratch, free_endpoint};
use quad_tests::{PATIENCE, eventually};

#[tokio::test(flavor = "multi_thread")]
async fn one_of_two_learners_with_one_name_stops() {
    let scratches = [Scratch::new(), Scratch::new()];
    let endpoint = free_endpoint();
    let mut learners = scratches
        .each_ref()
        .map(|scratch| scratch.learner_with("run", ENDLESS, &["--connect", &endpoint]));
    // Both wait for the router, and so come together.
    std::thread::sleep(Duration::from_secs(2));
    let _session = router(&endpoint).await;
    eventually("one of them stops", PATIENCE, || {
        learners.iter_mut().any(|learner| !learner.process.is_running()).then_some(())
    });
    let _evaluator = scratches[0].evaluator("shared", &endpoint);
    eventually("the other is evaluated", PATIENCE, || {
        learners.iter().any(|learner| !learner.scores().is_empty()).then_some(())
    });
    let running = learners
        .iter_mut()
        .filter_map(|learner| learner.process.is_running().then_some(()))
        .count();
    assert_eq!(running, 1);
    let said = learners.iter().map(|learner| learner.process.log()).filter(|log| {
        let told = log.contains("there is another learner of run run");
        told && log.contains("hint: choose another name for the folder with --run-dir")
    });
    assert_eq!(said.count(), 1);
}

#[test]
fn two_evaluators_with_one_name_cause_one_warning() {
    let scratch = Scratch::new();
    // Jobs of seconds, so that one of them has a job whenever the other one asks.
    let learner = scratch
        .learner("run", Setting { eval_interval: 500, candidates: 500, hidden: 256, ..ENDLESS });
    let folders = [Scratch::new(), Scratch::new()];
    let _both = folders.each_ref().map(|folder| folder.evaluator("twin", &learner.endpoint()));
    learner.process.wait_for_log("--name twin", PATIENCE);
    std::thread::sleep(Duration::from_secs(2));
    let log = learner.process.log();
    assert_eq!(log.lines().filter(|line| line.contains("--name twin")).count(), 1, "{log}");
    learner.wait_for_scores(0);
}
