//! Signals before a program listens for them, to a process of their own: this test, started again.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::env;
use std::io::{BufRead, BufReader, Write};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use quad_runtime::{LEAVE_WITHIN, shutdown_signal, unfinished_at_signal};
use rustix::process::{Pid, Signal, kill_process};
use tokio::runtime::Builder;

const ROLE: &str = "QUAD_TEST_ROLE";

#[test]
fn a_signal_before_the_work_begins_is_no_failure() {
    // The tests themselves may run under `nohup`.
    // SAFETY: this only sets the system's action at the signal.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_DFL) };
    match env::var(ROLE).as_deref() {
        Ok("early") => {
            unfinished_at_signal();
            println!("ready");
            std::io::stdout().flush().unwrap();
            std::thread::sleep(Duration::from_secs(300));
        }
        Ok(_) => {
            unfinished_at_signal();
            Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap().block_on(
                async {
                    let shutdown = shutdown_signal(LEAVE_WITHIN);
                    println!("ready");
                    std::io::stdout().flush().unwrap();
                    shutdown.await;
                },
            );
            std::process::exit(7);
        }
        Err(_) => {
            for signal in [Signal::INT, Signal::TERM, Signal::HUP, Signal::USR1] {
                assert_eq!(code_after("early", signal), Some(75), "{signal:?}");
                assert_eq!(code_after("listening", signal), Some(7), "{signal:?}");
            }
        }
    }
}

/// The exit code of a process that gets the signal once it is ready.
fn code_after(role: &str, signal: Signal) -> Option<i32> {
    let mut test = Command::new(env::current_exe().unwrap());
    let mut process =
        test.arg("--nocapture").env(ROLE, role).stdout(Stdio::piped()).spawn().unwrap();
    wait_until_ready(&mut process);
    kill_process(Pid::from_child(&process), signal).unwrap();
    process.wait().unwrap().code()
}

fn wait_until_ready(process: &mut Child) {
    let lines = BufReader::new(process.stdout.take().unwrap()).lines();
    assert!(lines.map_while(Result::ok).any(|line| line.ends_with("ready")));
}
