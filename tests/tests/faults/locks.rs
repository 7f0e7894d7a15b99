//! A run's folder where files have no locks.

use std::fs;

use quad_tests::PATIENCE;
use quad_tests::process::preload;
use quad_tests::setting::{ENDLESS, SHORT};
use quad_tests::system::Scratch;

use crate::disk::LISTEN;

#[test]
fn without_file_locks_a_folder_has_one_learner() {
    let [scratch, beside] = [Scratch::new(), Scratch::new()];
    let launcher = preload("no_locks");
    let folder = scratch.path().join("run");
    let start = |from: &Scratch| {
        from.learner_through(&launcher, folder.to_str().unwrap(), ENDLESS, &LISTEN)
    };
    let mut first = start(&scratch);
    let _evaluator = scratch.evaluator("one", &first.endpoint());
    first.wait_for_scores(0);
    let claim = folder.join("scores.host");
    assert!(claim.exists());
    let mut second = start(&beside);
    second.process.assert_ends(75, PATIENCE);
    second.process.assert_said("another learner is at work in");

    // One that was killed on this host keeps no learner out.
    first.process.kill();
    let mut next = start(&scratch);
    next.process.wait_for_log("continues after step", PATIENCE);
    next.assert_scores_are_distinct();
    next.process.kill();

    // Of another host this one knows nothing.
    fs::write(&claim, "elsewhere\n").unwrap();
    let mut third = start(&scratch);
    third.process.assert_ends(1, PATIENCE);
    third.process.assert_said("scores.host");
    third.process.assert_said("hint: wait for the end of that learner");
}

#[test]
fn a_learner_that_ends_takes_its_claim_back() {
    let scratch = Scratch::new();
    let flags = [&LISTEN[..], &["--evaluators", "1"]].concat();
    let mut learner = scratch.learner_through(&preload("no_locks"), "run", SHORT, &flags);
    learner.assert_completes(PATIENCE);
    assert!(!learner.run_dir.join("scores.host").exists());
}
