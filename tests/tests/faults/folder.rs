//! A learner continues from what its run's folder holds, whatever has become of that.

use std::fs;
use std::process::Command;

use quad_tests::process::{preload, stdout};
use quad_tests::setting::{ENDLESS, SHORT, Setting};
use quad_tests::system::Scratch;

use crate::disk::LISTEN;

#[test]
fn a_folder_has_one_learner_with_or_without_file_locks() {
    for launcher in [&[][..], &preload("no_locks")] {
        let [scratch, beside] = [Scratch::new(), Scratch::new()];
        let folder = scratch.path().join("run");
        let start = |from: &Scratch, flags: &[&str]| {
            let flags = [&LISTEN[..], flags].concat();
            from.learner_through(launcher, folder.to_str().unwrap(), ENDLESS, &flags)
        };
        let mut first = start(&scratch, &[]);
        first.process.wait_for_log("snapshot handed to evaluation");
        let mut second = start(&beside, &[]);
        second.process.assert_ends(75);
        second.process.assert_said("another learner is at work in");
        // One that was killed on this host keeps no learner out.
        first.process.kill();
        let mut next = start(&scratch, &[]);
        next.process.wait_for_log("continues after step");
        next.process.kill();

        let claim = folder.join("scores.host");
        assert_eq!(claim.exists(), !launcher.is_empty());
        if claim.exists() {
            // Of another host this one knows nothing.
            fs::write(&claim, "elsewhere\n").unwrap();
            let mut third = start(&scratch, &[]);
            third.process.assert_ends(1);
            third.process.assert_said("scores.host");
            third.process.assert_said("hint: wait for the end of that learner");
        } else {
            let fresh = start(&scratch, &["--fresh"]);
            fresh.process.wait_for_log("snapshot handed to evaluation");
            fresh.process.assert_not_said("continues after step");
            assert!(scratch.path().join("run.old1/config.toml").exists());
        }
    }
}

/// Copies a run in the order of rsync: by name. An old checkpoint may be gone by then.
const COPY: &str =
    "mkdir -p copy/run && tar -C run --sort=name -c . 2>/dev/null | tar -C copy/run -x";

#[test]
fn a_copy_of_a_run_at_work_continues_to_the_same_end() {
    let scratch = Scratch::new();
    let setting = Setting { steps: 3000, eval_interval: 300, hidden: 64, ..SHORT };
    let mut learner = scratch.learner_with("run", setting, &LISTEN);
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    learner.wait_for_scores(1);
    stdout(&Command::new("sh").args(["-c", COPY]).current_dir(scratch.path()).output().unwrap());
    learner.assert_completes();
    let mut copied = scratch.learner_with("copy/run", setting, &LISTEN);
    let _evaluator = scratch.evaluator("two", &copied.endpoint());
    copied.assert_completes();
    copied.assert_same_as(&learner);
}

#[test]
fn a_run_whose_folder_is_removed_ends() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner("run", ENDLESS);
    learner.process.wait_for_log("snapshot handed to evaluation");
    fs::rename(&learner.run_dir, scratch.path().join("elsewhere")).unwrap();
    learner.process.assert_ends(1);
    learner.process.assert_said("was removed or renamed");
    learner.process.assert_said("hint: put it back");
}
