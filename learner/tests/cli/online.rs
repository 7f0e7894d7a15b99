//! A learner that gets online.

use std::net::TcpListener;
use std::process::Command;

use quad_protocol::{Name, keys};
use quad_runtime::{Endpoints, open_session};

use crate::write_dataset;

/// After a crash, the token of the dead learner is still there for some seconds, in which the next one waits to see if it goes.
#[tokio::test(flavor = "multi_thread")]
async fn while_a_learner_waits_for_the_token_of_another_one_to_go_it_hears_that_training_has_failed() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = folder.path().join("tiny.hdf5");
    write_dataset(&dataset);
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let other = open_session(&Endpoints { listen: vec![endpoint.clone()], ..Endpoints::default() }).await.unwrap();
    let token = keys::live_learner(&Name::new("run").unwrap(), 1);
    let _token = other.liveliness().declare_token(token).await.unwrap();

    let mut learner = Command::new(env!("CARGO_BIN_EXE_learner"));
    learner.args(["train", "--task", "hopper-demo", "--set", "batch_size=4"]);
    learner.args(["--agent", "actor.hidden=[8]", "--agent", "critic.hidden=[8]"]);
    learner.args(["--agent", "critic_learning_rate=1e30", "--connect", &endpoint]);
    learner.arg("--dataset").arg(&dataset).arg("--run-dir").arg(folder.path().join("run"));
    let output = tokio::task::spawn_blocking(move || learner.output().unwrap()).await.unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    // One that heard nothing would say after eight seconds that there is another learner.
    assert!(text.contains("training diverged"), "{text}");
}
