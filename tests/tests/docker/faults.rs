//! What can happen to each container happens once, and at the end the run has the scores of one that nothing happened to.
//! The faults' schedule at random moments is tested with processes.

use std::thread::sleep;
use std::time::Duration;

use quad_tests::eventually;

use crate::compose::{Compose, LIGHT, PATIENCE, crash, has_ended, logs, succeeds, wait_for_log};

/// Longer than Zenoh's patience with a connection on which nothing arrives.
const A_WHILE: Duration = Duration::from_secs(7);
/// What a learner says of each evaluation that it opens; waited for, so that it is hit in the middle of its work.
const WORK: &str = "snapshot handed to evaluation";

fn pause(container: &str) {
    // Where a process of the container cannot be stopped just then, the engine gives up.
    let paused = eventually("the container is paused", PATIENCE, || {
        let paused = succeeds(&["pause", container]);
        (paused || has_ended(container)).then_some(paused)
    });
    if paused {
        sleep(A_WHILE);
        assert!(succeeds(&["unpause", container]));
    }
}

/// Takes a container off the network for a while. It comes back with its service's name, and perhaps another address.
fn cut_off(compose: &Compose, service: &str, container: &str) {
    let network = compose.network();
    assert!(succeeds(&["network", "disconnect", &network, container]));
    sleep(A_WHILE);
    assert!(succeeds(&["network", "connect", "--alias", service, &network, container]));
}

#[test]
#[ignore = "ten minutes, after the images"]
fn whatever_happens_to_containers_the_run_ends_as_if_nothing_had() {
    let arguments = format!("{LIGHT} --steps 400000 --eval-interval 20000");
    let Some(mut compose) = Compose::project("calm", &arguments) else { return };
    let up = ["up", "--detach", "--scale", "evaluator=2", "learner", "evaluator"];
    compose.run(&up);
    compose.assert_run_is_complete("calm", None);

    compose.set("QUAD_RUN", "faults");
    compose.run(&up);
    let [learner, router] = ["learner", "router"].map(|service| compose.container(service));
    let evaluator = compose.containers("evaluator").remove(0);
    wait_for_log(&learner, WORK, 2);
    assert!(crash(&evaluator) && crash(&learner));
    cut_off(&compose, "evaluator", &evaluator);
    cut_off(&compose, "learner", &learner);
    cut_off(&compose, "router", &router);
    for container in [&evaluator, &router, &learner] {
        pause(container);
    }
    assert!(succeeds(&["restart", "--time", "2", &router]));
    assert!(!has_ended(&learner), "the run was over too soon");
    compose.run(&["kill"]);
    compose.run(&up);

    let verdict = compose.assert_run_is_complete("faults", Some("calm"));
    assert!(verdict.contains("80 of 80 episodes are "), "{verdict}");
    let log = logs(&learner);
    let steps =
        log.lines().filter_map(|line| line.split_once("continues after step ")?.1.split(';').next()?.parse().ok());
    let steps: Vec<u64> = steps.collect();
    assert!(steps.len() == 2 && 0 < steps[0] && steps[0] < steps[1], "it went on after steps {steps:?}");
    eprintln!("gone on after steps {steps:?}; {verdict}");
}
