//! Programs that are told to leave do so in order, whatever they wait for just then.

use std::io::Write;
use std::process::Stdio;

use quad_protocol::keys;
use quad_runtime::open_router;
use quad_tests::made_up::name;
use quad_tests::process::signal;
use quad_tests::setting::{ENDLESS, SHORT, Setting};
use quad_tests::system::Scratch;
use quad_tests::{eventually, wait_until};

#[test]
fn an_unread_stderr_blocks_neither_work_nor_exit() {
    let scratch = Scratch::new();
    let (_unread, stderr) = std::io::pipe().unwrap();
    let mut filler = stderr.try_clone().unwrap();
    // Blocks once the pipe is full: this test never reads it.
    std::thread::spawn(move || while filler.write(&[b'.'; 1000]).is_ok() {});
    for (run, setting, code) in [("short", SHORT, 0), ("endless", ENDLESS, 75)] {
        let dir = scratch.path().join(run);
        let mut train = scratch.train(&[], &dir, setting);
        train.args(["--listen", "tcp/127.0.0.1:0", "--evaluators", "1"]);
        train.stdin(Stdio::null()).stdout(Stdio::null()).stderr(stderr.try_clone().unwrap());
        let mut learner = train.spawn().unwrap();
        if code == 75 {
            let scores = dir.join("scores.jsonl");
            wait_until("scores", || scores.metadata().is_ok_and(|file| file.len() > 0));
            signal("TERM", learner.id());
        }
        // One that has to end itself is not a success.
        let status = eventually("the learner ends", || learner.try_wait().unwrap());
        assert_eq!(status.code(), Some(code));
    }
}

/// A closed session, and what Slurm sends before the end of a time limit; but not where `nohup`
/// keeps a session's end away.
#[test]
fn every_stop_signal_leaves_the_run_to_the_same_command() {
    let scratch = Scratch::new();
    // The tests themselves may run under `nohup`.
    let [session, nohup] = ["--default-signal=HUP", "--ignore-signal=HUP,CHLD"]
        .map(|how| ["env", how].map(str::to_owned));
    let listen = ["--listen", "tcp/127.0.0.1:0", "--evaluators", "1"];
    for (run, launcher, signals) in [
        ("hup", &session, &["HUP"][..]),
        ("usr1", &session, &["USR1"]),
        ("nohup", &nohup, &["HUP", "TERM"]),
    ] {
        let mut learner = scratch.learner_through(launcher, run, ENDLESS, &listen);
        for signal in signals {
            learner.wait_for_scores(1);
            learner.process.signal(signal);
        }
        learner.process.assert_ends(75);
        let last = signals.last().unwrap();
        learner.process.assert_said(&format!("received SIG{last}"));
        assert_eq!(learner.process.log().matches("received SIG").count(), 1);
        let next = scratch.learner_through(launcher, run, ENDLESS, &listen);
        next.process.wait_for_log("continues after step");
    }
}

/// After a crash, the token of the dead learner is still there for some seconds.
#[tokio::test(flavor = "multi_thread")]
async fn a_learner_that_waits_for_another_reports_failures_and_stops() {
    let scratch = Scratch::new();
    let (session, endpoint) = open_router().await.unwrap();
    let token = keys::live_learner(&name("run"), 1);
    let _other = session.liveliness().declare_token(token).await.unwrap();
    let diverges = ["--connect", &endpoint, "--agent", "critic_learning_rate=1e30"];
    let mut learner = scratch.learner_with("run", ENDLESS, &diverges);
    learner.process.assert_ends(1);
    // One that heard nothing would say in the end that there is another learner.
    learner.process.assert_said("training diverged");

    let fresh = ["--connect", &endpoint, "--fresh"];
    let mut learner = scratch.learner_with("run", ENDLESS, &fresh);
    learner.process.wait_for_log("waiting to see if it is gone");
    learner.process.signal("TERM");
    learner.process.assert_ends(75);
}

#[test]
fn an_evaluator_told_to_leave_hands_its_job_back() {
    let scratch = Scratch::new();
    // Jobs that take seconds.
    let learner = scratch.learner("run", Setting { candidates: 200, hidden: 256, ..ENDLESS });
    let mut number = 0;
    eventually("a job is handed back", || {
        number += 1;
        let mut evaluator = scratch.evaluator(&format!("evaluator-{number}"), &learner.endpoint());
        evaluator.wait_for_log("evaluating");
        evaluator.signal("TERM");
        // A busy machine may take longer than it has.
        assert!(matches!(evaluator.wait().code(), Some(0 | 75)));
        learner.metric("jobs_total", "outcome=\"handed_back\"").filter(|jobs| *jobs > 0.0)
    });
}
