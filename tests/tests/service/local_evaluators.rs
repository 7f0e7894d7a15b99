//! `learner train --evaluators N`: one command that starts its own evaluators.

use std::fs;
use std::path::Path;

use quad_tests::learner::Learner;
use quad_tests::process::{children, signal};
use quad_tests::router::router;
use quad_tests::setting::{ENDLESS, SHORT, Setting};
use quad_tests::system::{Scratch, free_endpoint};
use quad_tests::{PATIENCE, eventually};

/// Seconds of training, so that the evaluators are ready before the run is complete.
const SECONDS: Setting = Setting { steps: 10_000, eval_interval: 2500, ..SHORT };

fn learner(scratch: &Scratch, setting: Setting) -> Learner {
    scratch.learner_with("run", setting, &["--listen", "tcp/127.0.0.1:0", "--evaluators", "2"])
}

/// True if none of them runs. A killed process that was not waited for does not run.
fn are_gone(processes: &[u32]) -> Option<()> {
    let runs = |id: &u32| {
        let stat = fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
        stat.split(") ").nth(1).is_some_and(|state| !state.starts_with('Z'))
    };
    (!processes.iter().any(runs)).then_some(())
}

/// The line of an evaluator's log with these words, once it is there.
fn line_of(log: &Path, words: &str) -> String {
    eventually(words, PATIENCE, || {
        let log = fs::read_to_string(log).ok()?;
        log.lines().find(|line| line.contains(words)).map(str::to_owned)
    })
}

/// The two evaluators of a learner, once there are new scores.
fn at_work(learner: &Learner) -> Vec<u32> {
    learner.wait_for_scores(learner.scores().len());
    let two = || Some(children(learner.process.id())).filter(|processes| processes.len() == 2);
    eventually("there are two evaluators", PATIENCE, two)
}

#[test]
fn two_runs_on_one_machine_need_no_ports() {
    let scratch = Scratch::new();
    let mut by_default = scratch.learner_with("default", SHORT, &[]);
    let mut learner = scratch.learner_with("run", SECONDS, &["--evaluators", "2"]);
    by_default.assert_completes(PATIENCE);
    let logs = [1, 2].map(|number| learner.run_dir.join(format!("evaluator-{number}.log")));
    for log in &logs {
        line_of(log, "ready to serve");
    }
    learner.assert_completes(PATIENCE);
    for log in &logs {
        line_of(log, "leaving");
    }
}

#[test]
fn evaluators_end_with_their_learner() {
    let scratch = Scratch::new();
    for signal in ["INT", "KILL"] {
        let mut learner = learner(&scratch, ENDLESS);
        let evaluators = at_work(&learner);
        learner.process.signal(signal);
        let status = learner.process.wait(PATIENCE);
        assert_eq!(status.code(), (signal == "INT").then_some(75));
        eventually("the evaluators are gone", PATIENCE, || are_gone(&evaluators));
    }
    let mut learner = learner(&scratch, ENDLESS);
    learner.process.wait_for_log("continues after step", PATIENCE);
    learner.assert_scores_are_distinct();
    learner.process.terminate(PATIENCE);
}

#[test]
fn a_dead_evaluator_is_reported_and_replaced() {
    let scratch = Scratch::new();
    let learner = learner(&scratch, ENDLESS);
    let evaluators = at_work(&learner);
    evaluators.iter().for_each(|evaluator| signal("KILL", *evaluator));
    let line = learner.process.wait_for_log("an evaluator has ended", PATIENCE);
    assert!(line.contains("signal: 9") && line.contains("evaluator-"), "{line}");
    let others =
        || children(learner.process.id()).into_iter().filter(|id| !evaluators.contains(id)).count();
    eventually("there are two others", PATIENCE, || (others() == 2).then_some(()));
    learner.wait_for_scores(learner.scores().len());
}

#[tokio::test(flavor = "multi_thread")]
async fn evaluators_of_two_learners_have_different_names() {
    let scratch = Scratch::new();
    let endpoint = free_endpoint();
    let _router = router(&endpoint).await;
    let start =
        |run| scratch.learner_with(run, SECONDS, &["--connect", &endpoint, "--evaluators", "1"]);
    let mut learners = ["one", "two"].map(start);
    let names = learners.each_ref().map(|learner| {
        let line = line_of(&learner.run_dir.join("evaluator-1.log"), "evaluator=");
        line.split_once("evaluator=").unwrap().1.to_owned()
    });
    assert_ne!(names[0], names[1]);
    for learner in &mut learners {
        learner.assert_completes(PATIENCE);
        learner.process.assert_not_said("two evaluators were started");
    }
}

/// A lab may set the variable for all users of a machine.
#[test]
fn local_runs_ignore_certificates_of_the_environment() {
    let scratch = Scratch::new();
    for (folder, flags) in
        [("/nowhere", ["--evaluators", "1"]), ("", ["--listen", "tcp/127.0.0.1:0"])]
    {
        let launcher = ["env".to_owned(), format!("QUAD_CERTIFICATES={folder}")];
        let learner = scratch.learner_through(&launcher, "run", ENDLESS, &flags);
        learner.process.wait_for_log("run run is at tcp/", PATIENCE);
    }
}
