//! A learner that crashes goes on by itself, and after `docker compose kill` with `docker compose up`.

use std::time::Instant;

use crate::compose::{Compose, LIGHT, crash, inspect, logs, wait_for_log};

/// What a learner says of each evaluation that it opens; waited for, so that it is hit in the middle of its work.
const WORK: &str = "snapshot handed to evaluation";

#[test]
#[ignore = "builds the images: cargo test --release --workspace --test docker -- --ignored"]
fn compose_goes_on_with_a_run_after_a_crash() {
    let Some(compose) = Compose::project("crash", &format!("{LIGHT} --steps 120000 --eval-interval 10000")) else {
        return;
    };
    let begin = Instant::now();
    let up = || compose.run(&["up", "--detach", "learner", "evaluator"]);
    up();
    let learner = compose.container("learner");
    wait_for_log(&learner, WORK, 3);
    assert!(crash(&learner));
    assert_eq!(inspect(&learner, "{{.RestartCount}}"), "1");
    wait_for_log(&learner, WORK, 6);
    compose.run(&["kill"]);
    up();

    let verdict = compose.assert_run_is_complete("crash", None);
    assert!(verdict.contains("48 of 48 episodes are scored"), "{verdict}");
    let log = logs(&learner);
    let steps =
        log.lines().filter_map(|line| line.split_once("goes on after step ")?.1.split(';').next()?.parse().ok());
    let steps: Vec<u64> = steps.collect();
    assert!(steps.len() == 2 && 0 < steps[0] && steps[0] < steps[1], "it went on after steps {steps:?}");

    // A run that is complete stays so.
    up();
    compose.assert_run_is_complete("crash", None);
    eprintln!("killed in the middle twice, gone on after steps {steps:?}, {verdict} ({:.0?})", begin.elapsed());
}
