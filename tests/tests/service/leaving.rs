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
use quad_tests::{PATIENCE, eventually, in_some_try};

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
    let serve = ["serve", "--name", "mute", "--connect", &endpoint];
    in_some_try("both leave in order, the learner with a checkpoint", |number| {
        let learner = learner("run", ENDLESS, &["--listen", &endpoint]);
        let evaluator = start(Command::new(binary("evaluator")).args(serve));
        eventually("there are scores", PATIENCE, || {
            let lines = std::fs::read_to_string(run_dir.join("scores.jsonl")).ok()?;
            (lines.lines().count() > 20 * (number + 1)).then_some(())
        });
        let left = (leaves(evaluator), leaves(learner));
        let mut checkpoints = std::fs::read_dir(run_dir.join("checkpoints")).into_iter().flatten();
        left == (Some(0), Some(75)) && checkpoints.next().is_some()
    });
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
        in_some_try("it leaves in order, with a checkpoint", |_| {
            let mut learner = scratch.learner_through(launcher, run, ENDLESS, &listen);
            learner.wait_for_scores(learner.scores().len());
            if run == "nohup" {
                learner.process.signal("HUP");
                learner.wait_for_scores(learner.scores().len());
            }
            learner.process.signal(signal);
            learner.process.assert_ends(75, PATIENCE);
            learner.process.assert_said(&format!("received SIG{signal}"));
            let is_in_order = learner.process.log().contains("the same command continues");
            is_in_order && !learner.files("checkpoints").is_empty()
        });
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

    in_some_try("it ends in order", |_| {
        let fresh = ["--connect", &endpoint, "--fresh"];
        let mut learner = scratch.learner_with("run", ENDLESS, &fresh);
        learner.process.wait_for_log("waiting to see if it is gone", PATIENCE);
        let status = learner.process.terminate(PATIENCE);
        assert_eq!(status.code(), Some(75), "{}", learner.process.log());
        learner.process.log().contains("the same command continues from there")
    });
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluator_that_leaves_in_the_middle_of_a_job_hands_it_back() {
    let scratch = Scratch::new();
    // A job of seconds, of short steps: a leaving evaluator waits two seconds for the learner's
    // answer, which needs the processor, too.
    let sizes = Setting { candidates: 100, hidden: 256, ..ENDLESS };
    let setting = Setting { steps: 10_000_000, eval_interval: 10, episodes: 40, ..sizes };
    let learner = scratch.learner("run", setting);
    let behind = free_endpoint();
    let _router = router_without_scores(&behind, Some(&learner.endpoint())).await;
    let jobs = |outcome| learner.metric("jobs_total", &format!("outcome=\"{outcome}\""));
    in_some_try("the job is handed back", |number| {
        let mut evaluator = scratch.evaluator("leaver", &behind);
        evaluator.process.wait_for_log("evaluating", PATIENCE);
        let status = evaluator.process.terminate(PATIENCE);
        let handed_back = eventually("the job is taken back", PATIENCE, || {
            let [handed_back, expired] = [jobs("handed_back")?, jobs("expired")?];
            (handed_back + expired > number as f64).then_some(handed_back)
        });
        status.success() && handed_back > 0.0
    });
}
