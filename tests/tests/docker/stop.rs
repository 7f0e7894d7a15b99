//! `docker compose stop` also ends a program that does not listen to signals, or not yet.

use std::time::{Duration, Instant};

use crate::compose::{Compose, docker, inspect};

/// Longer than anything ends by itself; after it, Docker kills.
const GRACE: &str = "60";

#[test]
#[ignore = "builds the images: cargo test --release --workspace --test docker -- --ignored"]
fn whoever_does_not_listen_to_signals_ends_at_once() {
    let Some(compose) = Compose::project("stop", "") else { return };
    for service in ["learner", "evaluator", "dataset"] {
        let deaf = compose.run(&["run", "--detach", "--no-deps", "--entrypoint", "sleep", service, "600"]);
        let deaf = deaf.trim();
        let begin = Instant::now();
        docker(&["stop", "--time", GRACE, deaf]);
        let took = begin.elapsed();
        assert!(took < Duration::from_secs(30), "{service} took {took:?}");
        assert_eq!(inspect(deaf, "{{.State.ExitCode}}"), "143", "the exit code of what SIGTERM ended");
        docker(&["rm", deaf]);
    }
}
