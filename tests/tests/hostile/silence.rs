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
use quad_tests::{PATIENCE, eventually, in_some_try};

/// Variable with the endpoint and the name of the stranger, which is also that of the file by which
/// it learns that the learner knows it.
const STRANGER: &str = "QUAD_TESTS_STRANGER";

const TEST: &str = "silence::a_peer_that_reads_nothing_blocks_neither_jobs_nor_snapshots";

/// Asks for weights again and again, wants all that is published, and then reads nothing: the
/// process stops itself.
async fn read_nothing(endpoint: &str, stranger: &str) {
    let (session, run) = (client(endpoint).await, name("run"));
    let _all = session.declare_subscriber("quad/run/**").callback(drop).await.unwrap();
    let token = keys::live_evaluator(&run, &name(stranger));
    let _token = session.liveliness().declare_token(token).await.unwrap();
    // Without this, a busy machine might stop the process before it has sent the token.
    eventually("the learner knows the stranger", PATIENCE, || {
        Path::new(stranger).exists().then_some(())
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
    if let Ok(variable) = env::var(STRANGER) {
        let (endpoint, stranger) = variable.split_once(' ').unwrap();
        return read_nothing(endpoint, stranger).await;
    }
    let scratch = Scratch::new();
    // So many episodes that the evaluator never waits for training, however slow that is.
    let learner = scratch.learner("run", Setting { episodes: 400, ..ENDLESS });
    let _evaluator = scratch.evaluator("steady", &learner.endpoint());
    learner.wait_for_scores(0);
    // A job of a busy machine may take longer than the learner keeps a connection that is not read.
    in_some_try("an evaluator is served while a stranger reads nothing", |number| {
        let name = format!("stranger-{number}");
        let mut command = Command::new(env::current_exe().unwrap());
        command.args(["--exact", TEST]).current_dir(scratch.path());
        command.env(STRANGER, format!("{} {name}", learner.endpoint()));
        let stranger = Process::start(&name, scratch.path(), command);
        learner.process.wait_for_log(&format!("evaluator {name} is here"), PATIENCE);
        fs::write(scratch.path().join(&name), "").unwrap();
        let stat = format!("/proc/{}/stat", stranger.id());
        let scored = eventually("the stranger has stopped", PATIENCE, || {
            fs::read_to_string(&stat).ok()?.contains(") T ").then(|| learner.scores().len())
        });
        // Until the learner has closed the connection; the stranger itself does nothing anymore.
        learner.process.wait_for_log(&format!("evaluator {name} has left"), PATIENCE);
        learner.scores().len() > scored
    });
}
