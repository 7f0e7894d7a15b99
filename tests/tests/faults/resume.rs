//! A learner continues from what its run's folder holds, whatever has become of that.

use std::fs;
use std::path::Path;

use quad_protocol::{Hash, PieceReply};
use quad_tests::learner::Learner;
use quad_tests::made_up::{self, name};
use quad_tests::setting::{ENDLESS, SHORT, Setting};
use quad_tests::system::{Scratch, free_endpoint};
use quad_tests::{PATIENCE, in_some_try};

/// A few seconds of training with evaluations all along.
const LONG: Setting = Setting { steps: 3000, eval_interval: 300, episodes: 4, hidden: 64, ..SHORT };
const LISTEN: [&str; 2] = ["--listen", "tcp/127.0.0.1:0"];

#[test]
fn a_stopped_learner_resumes_at_its_step() {
    let scratch = Scratch::new();
    let learner = || scratch.learner("run", ENDLESS);
    let step_of = |learner: &Learner| -> u64 {
        let line = learner.process.wait_for_log("continues after step", PATIENCE);
        let step = line.split("continues after step ").nth(1).unwrap().split(',').next().unwrap();
        step.parse().unwrap()
    };
    in_some_try("it ends in order", |_| {
        let mut first = learner();
        first.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
        assert_eq!(first.process.terminate(PATIENCE).code(), Some(75));
        first.process.log().contains("the same command continues from there")
    });

    let mut second = learner();
    let step = step_of(&second);
    assert!(step >= ENDLESS.eval_interval, "{step}");
    // A damaged checkpoint falls back to the one before, here to the very beginning.
    second.process.kill();
    let (name, mut bytes) = second.files("checkpoints").pop_last().unwrap();
    bytes.truncate(bytes.len() / 2);
    fs::write(second.run_dir.join("checkpoints").join(name), bytes).unwrap();
    let mut third = learner();
    assert!(step_of(&third) < step);
    third.process.assert_said("is damaged");
    third.process.terminate(PATIENCE);
}

/// Copies a folder in the order of rsync: by name.
fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    let entries = fs::read_dir(from).unwrap();
    let mut paths = Vec::from_iter(entries.map(|entry| entry.unwrap().path()));
    paths.sort();
    for path in paths {
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else {
            // An old checkpoint may be gone by now.
            fs::copy(&path, target).ok();
        }
    }
}

/// A back-up is made while the learner works.
#[test]
fn a_copy_of_a_run_at_work_continues_to_the_same_end() {
    let (scratch, endpoint) = (Scratch::new(), free_endpoint());
    let flags = ["--listen", &endpoint, "--checkpoint-seconds", "0"];
    let mut learner = scratch.learner_with("run", LONG, &flags);
    let _evaluator = scratch.evaluator("one", &endpoint);
    learner.wait_for_scores(4 * LONG.episodes as usize);
    copy(&learner.run_dir, &scratch.path().join("copy/run"));
    learner.assert_completes(PATIENCE);
    let mut copied = scratch.learner_with("copy/run", LONG, &["--listen", &endpoint]);
    copied.assert_completes(PATIENCE);
    copied.assert_same_as(&learner);
}

#[test]
fn a_folder_has_one_configuration_and_one_learner() {
    let scratch = Scratch::new();
    let learner =
        |flags: &[&str]| scratch.learner_with("run", ENDLESS, &[&LISTEN[..], flags].concat());
    let mut first = learner(&["--seed", "1"]);
    first.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    first.process.kill();
    let mut other = learner(&["--seed", "6"]);
    other.process.assert_ends(1, PATIENCE);
    other.process.assert_said("seed: 1 there, 6 here");
    other.process.assert_said("--fresh");

    // Begun anew, the old one is kept.
    let fresh = learner(&["--seed", "6", "--fresh"]);
    fresh.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    assert!(scratch.path().join("run.old1/config.toml").exists());
    fresh.process.assert_not_said("continues after step");
    let mut twin = learner(&["--seed", "6"]);
    twin.process.assert_ends(75, PATIENCE);
    twin.process.assert_said("another learner is at work");
}

#[test]
fn a_run_whose_folder_is_removed_ends() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner("run", ENDLESS);
    learner.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    fs::rename(&learner.run_dir, scratch.path().join("elsewhere")).unwrap();
    learner.process.assert_ends(1, PATIENCE);
    learner.process.assert_said("was removed or renamed");
    learner.process.assert_said("hint: put it back");
}

/// As if the scores were of another machine's bits. Training has to come by the step again to find
/// out.
#[test]
fn other_weights_for_a_scored_step_end_the_run() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner("run", LONG);
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    learner.wait_for_scores(0);
    learner.process.kill();
    fs::remove_dir_all(learner.run_dir.join("checkpoints")).ok();
    let first = learner.scores().remove(0);
    let snapshot = learner.snapshot(first.step);
    let mut bytes = fs::read(&snapshot).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(&snapshot, &bytes).unwrap();
    let log = learner.run_dir.join("scores.jsonl");
    let weights = Hash::new(&bytes).to_string();
    fs::write(&log, fs::read_to_string(&log).unwrap().replace(&first.weights, &weights)).unwrap();
    let mut learner = scratch.learner("run", LONG);
    learner.process.assert_ends(1, PATIENCE);
    learner.process.assert_said(&format!("but {weights} were scored before"));
    learner.process.assert_said("hint: another kind of processor");
    assert!(fs::read(&snapshot).unwrap() == bytes, "what was scored is overwritten");
}

#[test]
fn a_damaged_snapshot_is_an_error_only_if_it_lacks_scores() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner("run", SHORT);
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    learner.process.assert_succeeds(PATIENCE);
    let step = SHORT.eval_interval;
    let mut bytes = fs::read(learner.snapshot(step)).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(learner.snapshot(step), bytes).unwrap();
    let mut learner = scratch.learner("run", SHORT);
    learner.process.assert_succeeds(PATIENCE);
    learner.process.assert_said("its file is damaged");

    let log = learner.run_dir.join("scores.jsonl");
    let lines = fs::read_to_string(&log).unwrap();
    let lost = lines.lines().find(|line| line.contains(&format!("\"step\":{step},"))).unwrap();
    fs::write(&log, lines.replace(&format!("{lost}\n"), "")).unwrap();
    let mut learner = scratch.learner("run", SHORT);
    learner.process.assert_ends(1, PATIENCE);
    learner.process.assert_said(&format!("without the snapshot of step {step}"));
    learner.process.assert_said("without the scores of 1 episode");
    learner.process.assert_said("hint: ");
}

/// A robot cannot play it again. Without a checkpoint, training takes seconds to come to it.
#[tokio::test(flavor = "multi_thread")]
async fn an_episode_that_was_played_before_a_crash_is_recorded_after_it() {
    let (scratch, endpoint, run) = (Scratch::new(), free_endpoint(), name("run"));
    let setting = Setting { eval_interval: 1_000_000, online_steps: 3000, ..LONG };
    let flags = ["--listen", &endpoint, "--checkpoint-seconds", "3600"];
    let start = || scratch.learner_with("run", setting, &flags);
    let mut learner = start();
    let session = made_up::client(&learner.endpoint()).await;
    let first = made_up::claim_eventually(&session, &run, "one").await;
    let second = made_up::claim_eventually(&session, &run, "two").await;
    for job in [first, second] {
        learner.process.kill();
        learner = start();
        let session = made_up::client(&learner.endpoint()).await;
        let answer = made_up::deliver_experience(&session, &job, "one").await;
        assert!(matches!(answer, PieceReply::Recorded { .. }), "{answer:?}");
    }
}
