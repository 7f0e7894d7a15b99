//! Real signals, sent to this very process; so there is only this one test in the file.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use quad_runtime::{LEAVE_WITHIN, shutdown_signal};
use rustix::process::{Signal, getpid, kill_process};
use tokio::runtime::{Builder, Runtime};
use tokio::time::timeout;

#[test]
fn each_signal_is_noticed_even_before_it_is_awaited() {
    // The tests themselves may run under `nohup`.
    // SAFETY: it only sets what the system does at the signal.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_DFL) };
    // At once, not by another program: a second signal that comes late would end this process.
    let send = |signal| kill_process(getpid(), signal).unwrap();
    use Signal as S;
    for [signal, other] in
        [[S::INT, S::TERM], [S::TERM, S::INT], [S::HUP, S::TERM], [S::USR1, S::TERM]]
    {
        // A runtime each: the end of it ends the watch, to which another signal would be a further
        // one.
        runtime().block_on(async {
            let shutdown = shutdown_signal(LEAVE_WITHIN);
            send(signal);
            timeout(Duration::from_secs(60), shutdown)
                .await
                .unwrap_or_else(|_| panic!("{signal:?} was not noticed"));
            // Ctrl-C reaches a script, too, which hands it on: that would end this very process.
            send(other);
            tokio::time::sleep(Duration::from_secs(1)).await;
        });
    }
    let quiet = runtime().block_on(async {
        timeout(Duration::from_millis(100), shutdown_signal(LEAVE_WITHIN)).await
    });
    assert!(quiet.is_err(), "a signal of the past is no reason to leave");
    // As `nohup` does before it starts a program.
    // SAFETY: it only sets what the system does at the signal.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_IGN) };
    let quiet = runtime().block_on(async {
        let shutdown = shutdown_signal(LEAVE_WITHIN);
        send(S::HUP);
        timeout(Duration::from_secs(1), shutdown).await
    });
    assert!(quiet.is_err(), "what is ignored from the start on stays ignored");
}

fn runtime() -> Runtime {
    Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap()
}
