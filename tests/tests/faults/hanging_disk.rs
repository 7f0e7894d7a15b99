//! A disk that hangs holds up neither the training nor the end.

use std::thread::sleep;
use std::time::Duration;

use quad_protocol::keys;
use quad_run::folder::RunDir;
use quad_tests::PATIENCE;
use quad_tests::hanging_disk::launcher;
use quad_tests::made_up::{claim_eventually, client, name};
use quad_tests::setting::ENDLESS;
use quad_tests::system::Scratch;

use crate::disk::{LISTEN, SETTING};

#[test]
fn a_hanging_disk_blocks_neither_training_nor_exit() {
    let scratch = Scratch::new();
    let next = 2 * SETTING.eval_interval;
    let snapshot = RunDir::at(&scratch.path().join("run")).snapshot_path(next);
    // After one signal it ends itself when its time is over, two end it at once.
    for (signals, code) in [(1, 75), (2, 130)] {
        let launcher = launcher("fsync", &snapshot);
        let mut learner = scratch.learner_through(&launcher, "run", SETTING, &LISTEN);
        learner.wait_for_metric("gradient_steps_total", "", |steps| steps == SETTING.steps as f64);
        sleep(Duration::from_millis(200));
        assert!(!snapshot.exists(), "the disk did not hang");
        for _ in 0..signals {
            learner.process.signal("TERM");
            learner.process.wait_for_log("received SIGTERM", PATIENCE);
            // Sooner, the next one would count as the same.
            sleep(Duration::from_millis(600));
        }
        learner.process.assert_ends(code, PATIENCE);
    }

    let mut learner = scratch.learner_with("run", SETTING, &LISTEN);
    let _evaluator = scratch.evaluator("one", &learner.endpoint());
    learner.assert_completes(PATIENCE);
}

#[tokio::test(flavor = "multi_thread")]
async fn claims_are_answered_while_reads_hang() {
    let scratch = Scratch::new();
    let (run, first) = (name("run"), ENDLESS.eval_interval);
    let hung = RunDir::at(&scratch.path().join("run")).snapshot_path(first);
    let listen = ["--listen", "tcp/127.0.0.1:0"];
    let learner = scratch.learner_through(&launcher("read", &hung), "run", ENDLESS, &listen);
    // The newest snapshot comes from memory.
    learner.wait_for_metric("snapshots_published_total", "", |published| published > 1.0);
    let session = client(&learner.endpoint()).await;
    for _ in 0..20 {
        session.get(keys::weights_at(&run, first)).timeout(PATIENCE).callback(drop).await.unwrap();
    }
    sleep(Duration::from_millis(200));
    // The answer cannot have waited for the disk, which never gives that snapshot.
    assert_eq!(claim_eventually(&session, &run, "a").await.step, first);
}
