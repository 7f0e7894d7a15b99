//! Everything at once, with the settings that Compose has: healthy, seen by Prometheus, and complete in the end.

use quad_tests::prometheus::Prometheus;
use quad_tests::{dashboard, eventually};
use serde_json::Value;
use std::collections::HashSet;

use crate::compose::{Compose, PATIENCE, crash, inspect};

const EVALUATORS: usize = 4;

#[test]
#[ignore = "ten minutes, after the images"]
fn compose_runs_the_whole_system() {
    let Some(compose) = Compose::project("whole", "--steps 12000 --eval-interval 1000 --episodes 8") else { return };
    compose.run(&["up", "--detach", "--scale", "evaluator=4", "--scale", "grafana=0"]);

    let prometheus = Prometheus { address: compose.run(&["port", "prometheus", "9090"]).trim().to_owned() };
    for (job, count) in [("learner", 1), ("evaluator", EVALUATORS)] {
        let expression = format!("sum(up{{job={job:?}}})");
        eventually(&expression, PATIENCE, || prometheus.value(&expression).filter(|up| *up == count as f64));
    }
    dashboard::assert_every_panel_shows_data(&prometheus, PATIENCE);

    let evaluators = compose.containers("evaluator");
    let others = ["learner", "router", "prometheus"].map(|service| compose.container(service));
    for container in evaluators.iter().chain(&others) {
        let state = inspect(container, "{{.State.Health.Status}} {{.Config.User}}");
        let (health, user) = state.split_once(' ').expect("two words");
        assert_eq!(health, "healthy", "{container}");
        assert!(!["", "0", "root"].contains(&user), "{container} runs as {user:?}");
    }

    assert!(crash(&others[0]), "the learner ended too soon");
    let verdict = compose.assert_run_is_complete("whole");
    assert!(verdict.contains("96 of 96 episodes are scored"), "{verdict}");
    let scores = compose.learner("cat /runs/whole/scores.jsonl");
    let scores = scores.lines().map(|line| serde_json::from_str::<Value>(line).expect("a JSON object"));
    let who: HashSet<String> = scores.map(|score| score["evaluator"].to_string()).collect();
    assert!(who.len() > 1, "one evaluator did all the work");
}
