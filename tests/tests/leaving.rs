//! Programs that are told to leave do so in order, whatever they wait for just then.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::io::{PipeReader, Write};
use std::os::fd::OwnedFd;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use quad_protocol::keys;
use quad_tests::made_up::name;
use quad_tests::process::binary;
use quad_tests::router::router;
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually};

const ENDLESS: Setting =
    Setting { steps: 100_000_000, eval_interval: 500, episodes: 6, candidates: 2, hidden: 16, seed: 1 };

/// A pipe that nobody reads, and that somebody fills; and what keeps it open.
fn full_pipe() -> (OwnedFd, PipeReader) {
    let (reader, writer) = std::io::pipe().unwrap();
    let mut filler = writer.try_clone().unwrap();
    // Blocks as soon as it is full, until the reader is dropped.
    std::thread::spawn(move || while filler.write(&[b'.'; 1000]).is_ok() {});
    (writer.into(), reader)
}

fn leaves(mut child: Child) -> Option<i32> {
    let begin = Instant::now();
    let signal = format!("kill -TERM {}", child.id());
    assert!(Command::new("sh").args(["-c", &signal]).status().unwrap().success());
    let status = eventually("it has left", PATIENCE, || child.try_wait().unwrap());
    assert!(begin.elapsed() < Duration::from_secs(9), "it took {:?}", begin.elapsed());
    status.code()
}

#[test]
fn a_stderr_that_nobody_reads_holds_up_neither_the_work_nor_the_end() {
    let scratch = Scratch::new();
    let preset = scratch.preset("run", ENDLESS);
    let (unread, _reader) = full_pipe();
    let start = |command: &mut Command| {
        command.stdout(Stdio::null()).stderr(unread.try_clone().unwrap()).stdin(Stdio::null()).spawn().unwrap()
    };
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let run_dir = scratch.path().join("run");
    let mut learner = Command::new(binary("learner"));
    learner.arg("train").arg("--preset").arg(preset).arg("--dataset").arg(scratch.dataset());
    learner.arg("--run-dir").arg(&run_dir).args(["--metrics", "127.0.0.1:0", "--listen", &endpoint]);
    let learner = start(&mut learner);
    let evaluator = start(Command::new(binary("evaluator")).args(["serve", "--name", "mute", "--connect", &endpoint]));
    let scored = || std::fs::read_to_string(run_dir.join("scores.jsonl")).is_ok_and(|lines| lines.lines().count() > 20);
    eventually("there are scores", PATIENCE, || scored().then_some(()));
    assert_eq!((leaves(evaluator), leaves(learner)), (Some(0), Some(1)));
    let checkpoints = std::fs::read_dir(run_dir.join("checkpoints")).unwrap().count();
    assert!(checkpoints > 0, "it has left without a checkpoint");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_learner_that_waits_for_another_to_be_gone_leaves_in_order() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let _other = session.liveliness().declare_token(keys::live_learner(&name("run"), 1)).await.unwrap();
    let mut learner = scratch.learner_with("run", ENDLESS, &["--connect", &endpoint]);
    learner.process.wait_for_log("waiting to see if it is gone", PATIENCE);
    let (took, status) = learner.process.terminate(PATIENCE);
    assert_eq!(status.code(), Some(1), "{}", learner.process.log());
    assert!(took < Duration::from_secs(5), "it took {took:?}");
    assert!(learner.process.log().contains("the same command goes on from there"), "{}", learner.process.log());
}
