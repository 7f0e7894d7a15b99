//! Programs that are told to leave do so in order, whatever they wait for just then.

use std::io::{PipeReader, Write};
use std::os::fd::OwnedFd;
use std::process::{Child, Command, Stdio};

use quad_protocol::keys;
use quad_tests::made_up::name;
use quad_tests::process::{binary, signal};
use quad_tests::router::{router, router_without_scores};
use quad_tests::setting::{ENDLESS, SHORT, Setting};
use quad_tests::system::{Scratch, free_endpoint};
use quad_tests::{PATIENCE, eventually};

/// A full pipe that is never read; and what keeps it open.
fn full_pipe() -> (OwnedFd, PipeReader) {
    let (reader, writer) = std::io::pipe().unwrap();
    let mut filler = writer.try_clone().unwrap();
    // Blocks as soon as it is full, until the reader is dropped.
    std::thread::spawn(move || while filler.write(&[b'.'; 1000]).is_ok() {});
    (writer.into(), reader)
}

/// The exit code of a program that is told to leave.
fn leaves(child: Child) -> Option<i32> {
    signal("TERM", child.id());
    ends(child)
}

/// The exit code of a program that ends.
fn ends(mut child: Child) -> Option<i32> {
    eventually("it has ended", PATIENCE, || child.try_wait().unwrap()).code()
}

#[test]
fn an_unread_stderr_blocks_neither_work_nor_exit() {
    let scratch = Scratch::new();
    let (unread, _reader) = full_pipe();
    let start = |command: &mut Command| {
        let stderr = unread.try_clone().unwrap();
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(stderr).spawn().unwrap()
    };
    let learner = |name: &str, setting, arguments: &[&str]| {
        start(scratch.train(&[], &scratch.path().join(name), setting).args(arguments))
    };
    // One that has to end itself is not a success.
    let short = learner("short", SHORT, &["--listen", "tcp/127.0.0.1:0", "--evaluators", "1"]);
    assert_eq!(ends(short), Some(0));
    let (endpoint, run_dir) = (free_endpoint(), scratch.path().join("run"));
    let learner = learner("run", ENDLESS, &["--listen", &endpoint]);
    let serve = ["serve", "--name", "mute", "--connect", &endpoint];
    let evaluator = start(Command::new(binary("evaluator")).args(serve));
    eventually("there are scores", PATIENCE, || {
        let lines = std::fs::read_to_string(run_dir.join("scores.jsonl")).ok()?;
        (lines.lines().count() > 20).then_some(())
    });
    assert_eq!((leaves(evaluator), leaves(learner)), (Some(0), Some(75)));
    let checkpoints = std::fs::read_dir(run_dir.join("checkpoints")).unwrap().count();
    assert!(checkpoints > 0, "it has left without a checkpoint");
}

/// A closed session, and what Slurm sends before the end of a time limit; but not where `nohup`
/// keeps a session's end away.
#[test]
fn every_stop_signal_ends_a_learner_with_a_checkpoint() {
    let scratch = Scratch::new();
    // The tests themselves may run under `nohup`.
    let [session, nohup] = ["--default-signal=HUP", "--ignore-signal=HUP,CHLD"]
        .map(|how| ["env", how].map(str::to_owned));
    for (run, launcher, signal) in
        [("hup", &session, "HUP"), ("usr1", &session, "USR1"), ("nohup", &nohup, "TERM")]
    {
        let listen = ["--listen", "tcp/127.0.0.1:0", "--evaluators", "1"];
        let mut learner = scratch.learner_through(launcher, run, ENDLESS, &listen);
        learner.wait_for_scores(0);
        if run == "nohup" {
            learner.process.signal("HUP");
            learner.wait_for_scores(learner.scores().len());
        }
        learner.process.signal(signal);
        learner.process.assert_ends(75, PATIENCE);
        learner.process.assert_said(&format!("received SIG{signal}"));
        assert!(!learner.files("checkpoints").is_empty(), "{run} has left without a checkpoint");
    }
}

/// After a crash, the token of the dead learner is still there for some seconds.
#[tokio::test(flavor = "multi_thread")]
async fn a_learner_that_waits_for_another_reports_failures_and_stops() {
    let scratch = Scratch::new();
    let endpoint = free_endpoint();
    let session = router(&endpoint).await;
    let _other =
        session.liveliness().declare_token(keys::live_learner(&name("run"), 1)).await.unwrap();
    let diverges = ["--connect", &endpoint, "--agent", "critic_learning_rate=1e30"];
    let mut learner = scratch.learner_with("run", ENDLESS, &diverges);
    learner.process.assert_ends(1, PATIENCE);
    // One that heard nothing would say in the end that there is another learner.
    learner.process.assert_said("training diverged");

    let mut learner = scratch.learner_with("run", ENDLESS, &["--connect", &endpoint, "--fresh"]);
    learner.process.wait_for_log("waiting to see if it is gone", PATIENCE);
    assert_eq!(learner.process.terminate(PATIENCE).code(), Some(75), "{}", learner.process.log());
    learner.process.assert_said("the same command continues from there");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluator_that_leaves_in_the_middle_of_a_job_hands_it_back() {
    let scratch = Scratch::new();
    // A job of seconds, of short steps: a leaving evaluator waits a second for the learner's answer,
    // which needs the processor, too.
    let sizes = Setting { candidates: 100, hidden: 256, ..ENDLESS };
    let setting = Setting { steps: 10_000_000, eval_interval: 10, episodes: 40, ..sizes };
    let learner = scratch.learner("run", setting);
    let behind = free_endpoint();
    let _router = router_without_scores(&behind, Some(&learner.endpoint())).await;
    let mut evaluator = scratch.evaluator("leaver", &behind);
    evaluator.process.wait_for_log("evaluating", PATIENCE);
    let status = evaluator.process.terminate(PATIENCE);
    assert_eq!(status.code(), Some(0), "the evaluator ended with {status}");
    let jobs = |outcome| learner.metric("jobs_total", &format!("outcome=\"{outcome}\""));
    let [handed_back, expired] = eventually("the job is taken back", PATIENCE, || {
        let ended = [jobs("handed_back")?, jobs("expired")?];
        (ended.iter().sum::<f64>() > 0.0).then_some(ended)
    });
    assert_eq!((handed_back, expired), (1.0, 0.0));
}
