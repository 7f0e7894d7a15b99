//! A peer that reads nothing.

use std::future::pending;
use std::path::Path;
use std::process::Command;
use std::{env, fs};

use quad_protocol::keys;
use quad_tests::made_up::{client, name};
use quad_tests::process::{Process, signal};
use quad_tests::setting::{ENDLESS, Setting};
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, eventually};

const STRANGER: &str = "QUAD_TESTS_STRANGER";
/// The file by which the stranger learns that the learner knows it.
const KNOWN: &str = "known";

/// Asks for weights again and again, wants all that is published, and then reads nothing: the
/// process stops itself.
async fn read_nothing(endpoint: &str) {
    let (session, run) = (client(endpoint).await, name("run"));
    let _all = session.declare_subscriber("quad/run/**").callback(drop).await.unwrap();
    let token = keys::live_evaluator(&run, &name("stranger"));
    let _token = session.liveliness().declare_token(token).await.unwrap();
    // Without this, a busy machine might stop the process before it has sent the token.
    eventually("the learner knows the stranger", PATIENCE, || {
        Path::new(KNOWN).exists().then_some(())
    });
    let weights = keys::weights_at(&run, ENDLESS.eval_interval);
    for _ in 0..150 {
        session.get(&weights).timeout(PATIENCE).callback(drop).await.unwrap();
    }
    signal("STOP", std::process::id());
    // A process stops a moment after the signal. Returning here would drop the token meanwhile.
    pending().await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_peer_that_reads_nothing_blocks_neither_jobs_nor_snapshots() {
    if let Ok(endpoint) = env::var(STRANGER) {
        return read_nothing(&endpoint).await;
    }
    let scratch = Scratch::new();
    // So many episodes that the evaluator never waits for training, however slow that is.
    let learner = scratch.learner("run", Setting { episodes: 400, ..ENDLESS });
    let _evaluator = scratch.evaluator("steady", &learner.endpoint());
    learner.wait_for_scores(0);
    let mut command = Command::new(env::current_exe().unwrap());
    command
        .args(["--exact", "silence::a_peer_that_reads_nothing_blocks_neither_jobs_nor_snapshots"]);
    command.env(STRANGER, learner.endpoint()).current_dir(scratch.path());
    let stranger = Process::start("stranger", scratch.path(), command);
    learner.process.wait_for_log("evaluator stranger is here", PATIENCE);
    fs::write(scratch.path().join(KNOWN), "").unwrap();
    let stat = format!("/proc/{}/stat", stranger.id());
    let scored = eventually("the stranger has stopped", PATIENCE, || {
        fs::read_to_string(&stat).ok()?.contains(") T ").then(|| learner.scores().len())
    });
    // Until the learner has closed the connection; the stranger itself does nothing anymore.
    learner.process.wait_for_log("evaluator stranger has left", PATIENCE);
    let meanwhile = learner.scores().len();
    assert!(meanwhile > scored, "no evaluator was served while the stranger read nothing");
}
