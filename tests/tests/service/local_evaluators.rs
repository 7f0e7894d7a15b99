//! `learner train --evaluators N`: one command that starts its own evaluators.

use std::fs;

use quad_tests::learner::Learner;
use quad_tests::process::{children, signal};
use quad_tests::setting::ENDLESS;
use quad_tests::system::Scratch;
use quad_tests::{eventually, wait_until};

const FLAGS: [&str; 4] = ["--listen", "tcp/127.0.0.1:0", "--evaluators", "2"];

/// A killed process that was not waited for does not run.
fn runs(process: u32) -> bool {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).unwrap_or_default();
    stat.split(") ").nth(1).is_some_and(|state| !state.starts_with('Z'))
}

/// The two evaluators of a learner, once there are new scores.
fn at_work(learner: &Learner) -> Vec<u32> {
    learner.wait_for_scores(1);
    let two = || Some(children(learner.process.id())).filter(|processes| processes.len() == 2);
    eventually("there are two evaluators", two)
}

#[test]
fn evaluators_end_with_their_learner() {
    let scratch = Scratch::new();
    for (signal, code) in [("INT", Some(75)), ("KILL", None)] {
        let mut learner = scratch.learner_with("run", ENDLESS, &FLAGS);
        let evaluators = at_work(&learner);
        learner.process.signal(signal);
        assert_eq!(learner.process.wait().code(), code);
        wait_until("the evaluators are gone", || !evaluators.iter().any(|&id| runs(id)));
    }
}

#[test]
fn a_dead_evaluator_is_reported_and_replaced() {
    let scratch = Scratch::new();
    let learner = scratch.learner_with("run", ENDLESS, &FLAGS);
    let evaluators = at_work(&learner);
    evaluators.iter().for_each(|&evaluator| signal("KILL", evaluator));
    let line = learner.process.wait_for_log("an evaluator has ended");
    assert!(line.contains("signal: 9") && line.contains("evaluator-"), "{line}");
    wait_until("there are two others", || {
        let children = children(learner.process.id());
        children.len() == 2 && !children.iter().any(|id| evaluators.contains(id))
    });
    learner.wait_for_scores(1);
}
