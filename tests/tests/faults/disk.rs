//! A full disk delays what is kept, and ends neither the training nor what was kept before.

use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use quad_protocol::{Snapshot, decode, keys};
use quad_tests::learner::Learner;
use quad_tests::made_up::{client, name};
use quad_tests::setting::{SHORT, Setting};
use quad_tests::small_disk::SmallDisk;
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, eventually, http};
use zenoh::Session;

/// Seconds of training, also where a step takes 50 µs: things happen in the middle of it.
pub const SETTING: Setting =
    Setting { steps: 40_000, eval_interval: 5_000, episodes: 4, hidden: 32, ..SHORT };
pub const LISTEN: [&str; 4] = ["--listen", "tcp/127.0.0.1:0", "--checkpoint-seconds", "0"];

/// The steps of the snapshots that are published from now on, and whether each was on the disk by
/// then.
async fn watch(learner: &Learner) -> (Session, Arc<Mutex<Vec<(u64, bool)>>>) {
    let session = client(&learner.endpoint()).await;
    let published = Arc::new(Mutex::new(Vec::new()));
    let (heard, folder) = (published.clone(), learner.run_dir.clone());
    let listener = move |sample: zenoh::sample::Sample| {
        let snapshot: Snapshot = decode(&sample.payload().to_bytes()).unwrap();
        let path: PathBuf = folder.join(format!("snapshots/step_{:09}.safetensors", snapshot.step));
        let kept = fs::read(path).is_ok_and(|bytes| bytes == snapshot.file);
        heard.lock().unwrap().push((snapshot.step, kept));
    };
    let weights = keys::weights(&name("run"));
    session.declare_subscriber(weights).callback(listener).background().await.unwrap();
    (session, published)
}

fn assert_unwell(learner: &Learner, reason: &str) {
    eventually(reason, PATIENCE, || {
        let (status, health) = http::get(&learner.metrics(), "/healthz")?;
        (status == 503 && health.contains(reason)).then_some(())
    });
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_delays_snapshots_scores_and_checkpoints_until_there_is_room() {
    let scratch = Scratch::new();
    let Some(disk) = SmallDisk::mount(&scratch.path().join("run"), 6) else { return };
    // Long enough for the disk to be full in the middle of it.
    let setting = Setting { hidden: 64, ..SETTING };
    let mut learner = scratch.learner_with("run", setting, &LISTEN);
    let (_session, published) = watch(&learner).await;
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    learner.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    disk.fill();
    learner.wait_for_metric("disk_trouble", "", |trouble| trouble > 0.0);
    let steps = learner.metric("gradient_steps_total", "").unwrap();
    learner.process.wait_for_log("No space left on device", PATIENCE);
    assert_unwell(&learner, "the run cannot be saved");
    // By now, snapshots have been due as well.
    let later = (steps + 2.0 * setting.eval_interval as f64).min(setting.steps as f64);
    learner.wait_for_metric("gradient_steps_total", "", |now| now >= later);
    let counted = learner.metric("scores_recorded_total", "").unwrap();
    let kept = learner.scores().len();
    assert!(kept as f64 >= counted, "{counted} scores count as kept, {kept} are on the disk");

    disk.clear();
    learner.process.wait_for_log("the run can be saved again", PATIENCE);
    learner.assert_completes(PATIENCE);
    let published = published.lock().unwrap();
    let are_kept = published.len() > 2 && published.iter().all(|(_, kept)| *kept);
    assert!(are_kept, "published before written: {published:?}");
}

#[test]
fn scores_wait_for_a_full_disk() {
    let scratch = Scratch::new();
    let Some(disk) = SmallDisk::mount(&scratch.path().join("run"), 6) else { return };
    let setting = Setting { steps: 500, eval_interval: 250, ..SETTING };
    let mut learner = scratch.learner_with("run", setting, &LISTEN);
    learner.process.wait_for_log("waiting for the scores", PATIENCE);
    disk.fill();
    let evaluator = scratch.evaluator("one", &learner.endpoint());
    learner.wait_for_metric("disk_trouble", "scores", |trouble| trouble == 1.0);
    learner.process.wait_for_log("results cannot be saved", PATIENCE);
    assert_unwell(&learner, "results cannot be saved");
    evaluator.process.wait_for_log("No space left on device", PATIENCE);
    assert!(learner.scores().is_empty());

    disk.clear();
    learner.process.wait_for_log("results can be saved again", PATIENCE);
    learner.assert_completes(PATIENCE);
    let page = http::metrics(&evaluator.metrics()).unwrap();
    let measured = http::sum(&page, "quad_evaluator_episodes_total", "");
    assert_eq!(measured, 8.0, "nothing is measured twice");
}
