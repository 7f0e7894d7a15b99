//! A full or hanging disk delays what is kept, and ends neither the training nor what was kept
//! before; a power cut leaves what was promised to be on the disk.

use std::fs;
use std::thread::sleep;
use std::time::Duration;

use quad_protocol::Hash;
use quad_run::folder::RunDir;
use quad_runtime::open_router;
use quad_tests::disk::{LosingDisk, SmallDisk, hanging};
use quad_tests::learner::Learner;
use quad_tests::setting::{SHORT, Setting};
use quad_tests::system::Scratch;
use quad_tests::{http, wait_until};

pub const SETTING: Setting =
    Setting { steps: 40_000, eval_interval: 5_000, episodes: 4, hidden: 32, ..SHORT };
pub const LISTEN: [&str; 4] = ["--listen", "tcp/127.0.0.1:0", "--checkpoint-seconds", "0"];

fn assert_unwell(learner: &Learner, reason: &str) {
    learner.process.wait_for_log("No space left on device");
    wait_until(reason, || {
        let health = http::get(&learner.metrics(), "/healthz");
        health.is_some_and(|(status, text)| status == 503 && text.contains(reason))
    });
}

#[test]
fn a_full_disk_delays_snapshots_and_checkpoints_until_there_is_room() {
    let scratch = Scratch::new();
    // The run itself fills it.
    let Some(disk) = SmallDisk::mount(&scratch.path().join("run"), 1) else { return };
    let setting = Setting { hidden: 64, ..SETTING };
    let mut learner = scratch.learner_with("run", setting, &LISTEN);
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    assert_unwell(&learner, "the run cannot be saved");
    let is_last = |steps| steps == setting.steps as f64;
    learner.wait_for_metric("gradient_steps_total", "", is_last);
    disk.grow();
    learner.process.wait_for_log("the run can be saved again");
    learner.assert_completes();
}

#[test]
fn scores_wait_for_a_full_disk() {
    let scratch = Scratch::new();
    let Some(disk) = SmallDisk::mount(&scratch.path().join("run"), 6) else { return };
    let setting = Setting { steps: 500, eval_interval: 250, ..SETTING };
    let mut learner = scratch.learner_with("run", setting, &LISTEN);
    learner.process.wait_for_log("waiting for the scores");
    disk.fill();
    let evaluator = scratch.evaluator("one", &learner.endpoint());
    let page = evaluator.wait_for_address("/metrics");
    assert_unwell(&learner, "results cannot be saved");
    evaluator.wait_for_log("No space left on device");
    assert!(learner.scores().is_empty());
    disk.grow();
    learner.assert_completes();
    let measured = http::sum(&http::metrics(&page).unwrap(), "quad_evaluator_episodes_total", "");
    assert_eq!(measured, 8.0, "nothing is measured twice");
}

#[test]
fn a_hanging_disk_blocks_neither_training_nor_exit() {
    let scratch = Scratch::new();
    let next = 2 * SETTING.eval_interval;
    let snapshot = RunDir::at(&scratch.path().join("run")).snapshot_path(next);
    for signals in [1, 2] {
        let launcher = hanging(&snapshot);
        let mut learner = scratch.learner_through(&launcher, "run", SETTING, &LISTEN);
        let is_last = |steps| steps == SETTING.steps as f64;
        learner.wait_for_metric("gradient_steps_total", "", is_last);
        learner.process.signal("TERM");
        if signals == 2 {
            // Sooner, the second would count as the first.
            sleep(Duration::from_secs(1));
            learner.process.signal("TERM");
        }
        let code = learner.process.wait().code();
        // A busy machine may notice the second after the time limit of the first.
        let is_second = learner.process.log().contains("ending at once");
        assert_eq!(code, Some(if is_second { 130 } else { 75 }), "{}", learner.process.log());
        assert!(!snapshot.exists(), "the disk did not hang");
    }
    let mut learner = scratch.learner_with("run", SETTING, &LISTEN);
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    learner.assert_completes();
}

#[tokio::test(flavor = "multi_thread")]
async fn power_cuts_lose_nothing_acknowledged() {
    let scratch = Scratch::new();
    let Some(mut disk) = LosingDisk::mount(&scratch.path().join("disk")) else { return };
    let (_router, endpoint) = open_router().await.unwrap();
    let _evaluators = ["one", "two"].map(|name| scratch.evaluator(name, &endpoint));
    let flags = ["--connect", &endpoint, "--checkpoint-seconds", "0"];
    // The folder above the run's is not there at first.
    let start = || scratch.learner_with("disk/runs/run", SETTING, &flags);
    let mut kept = 0;
    for _ in 0..3 {
        let mut learner = start();
        let mut acknowledged = 0.0;
        wait_until("scores are acknowledged", || {
            acknowledged = learner.metric("scores_recorded_total", "").unwrap_or(acknowledged);
            acknowledged > 0.0 || !learner.process.is_running()
        });
        learner.process.kill();
        disk.cut_power();
        let scores = learner.scores();
        assert!(scores.len() >= kept + acknowledged as usize, "an acknowledged score is lost");
        kept = scores.len();
        for score in scores {
            let snapshot = fs::read(learner.snapshot(score.step)).unwrap_or_default();
            let hash = Hash::new(&snapshot).to_string();
            assert_eq!(hash, score.weights, "the snapshot of step {} is lost", score.step);
        }
        learner.process.assert_not_said("is damaged");
    }
    let mut learner = start();
    learner.assert_completes();
    let mut calm = scratch.learner("calm", SETTING);
    let _evaluator = scratch.evaluator("three", &calm.endpoint());
    calm.assert_completes();
    learner.assert_same_as(&calm);
    // A run that is complete is so at once.
    let mut again = start();
    again.process.assert_ends(0);
    again.process.assert_said("mean score of the last 3 evaluations");
}
