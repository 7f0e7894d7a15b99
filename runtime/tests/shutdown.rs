//! Signals to processes of their own: this test, started again.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::env;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use quad_runtime::{LEAVE_WITHIN, shutdown_signal, unfinished_at_signal};
use rustix::process::{Pid, Signal, getpid, kill_process};
use tokio::runtime::{Builder, Runtime};
use tokio::time::timeout;

const ROLE: &str = "QUAD_TEST_ROLE";
const SIGNALS: [Signal; 4] = [Signal::INT, Signal::TERM, Signal::HUP, Signal::USR1];

#[test]
fn signals() {
    // The tests themselves may run under `nohup`.
    // SAFETY: this only sets the system's action at the signal.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_DFL) };
    match env::var(ROLE).as_deref() {
        Ok("early") => {
            unfinished_at_signal();
            println!("ready");
            sleep(Duration::from_secs(300));
        }
        Ok(_) => counts_each_signal_once(),
        Err(_) => {
            for signal in SIGNALS {
                assert_eq!(code("early", Some(signal)), Some(75), "{signal:?}");
            }
            assert_eq!(code("again", None), Some(0));
        }
    }
}

/// The exit code of a process that gets the signal once it is ready.
fn code(role: &str, signal: Option<Signal>) -> Option<i32> {
    let mut test = Command::new(env::current_exe().unwrap());
    let mut process =
        test.arg("--nocapture").env(ROLE, role).stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(process.stdout.take().unwrap()).lines();
    if let Some(signal) = signal {
        assert!(lines.by_ref().map_while(Result::ok).any(|line| line.ends_with("ready")));
        kill_process(Pid::from_child(&process), signal).unwrap();
    }
    lines.for_each(drop);
    process.wait().unwrap().code()
}

fn counts_each_signal_once() {
    // Ctrl-C reaches a script, too, which passes it on.
    runtime().block_on(async {
        let shutdown = shutdown_signal(LEAVE_WITHIN);
        SIGNALS.into_iter().for_each(send);
        shutdown.await;
        tokio::time::sleep(Duration::from_secs(1)).await;
    });
    let watch = async { timeout(Duration::from_millis(100), shutdown_signal(LEAVE_WITHIN)).await };
    assert!(runtime().block_on(watch).is_err(), "an earlier signal counts");
    // As `nohup` does before it starts a program.
    // SAFETY: this only sets the system's action at the signal.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_IGN) };
    let quiet = runtime().block_on(async {
        let shutdown = shutdown_signal(LEAVE_WITHIN);
        send(Signal::HUP);
        timeout(Duration::from_secs(1), shutdown).await
    });
    assert!(quiet.is_err(), "an ignored signal counts");
}

/// From this process: a second signal of another that comes late would end it.
fn send(signal: Signal) {
    kill_process(getpid(), signal).unwrap();
}

fn runtime() -> Runtime {
    Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap()
}
