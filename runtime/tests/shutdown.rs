//! Signals to this process, so there is only one test in the file.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::Duration;

use quad_runtime::{LEAVE_WITHIN, shutdown_signal};
use rustix::process::{Signal, getpid, kill_process};
use tokio::runtime::{Builder, Runtime};
use tokio::time::timeout;

#[test]
fn each_signal_is_noticed_before_it_is_awaited() {
    // The tests themselves may run under `nohup`.
    // SAFETY: this only sets the system's action at the signal.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_DFL) };
    // Not by another program: a second signal that comes late would end this process.
    let send = |signal| kill_process(getpid(), signal).unwrap();
    use Signal as S;
    let signals = [S::INT, S::TERM, S::HUP, S::USR1];
    for signal in signals {
        // The end of each runtime ends its watch.
        runtime().block_on(async {
            let shutdown = shutdown_signal(LEAVE_WITHIN);
            send(signal);
            timeout(Duration::from_secs(60), shutdown)
                .await
                .unwrap_or_else(|_| panic!("{signal:?} was not noticed"));
        });
    }
    // Ctrl-C reaches a script, too, which passes it on.
    runtime().block_on(async {
        let shutdown = shutdown_signal(LEAVE_WITHIN);
        for signal in signals {
            send(signal);
        }
        shutdown.await;
        tokio::time::sleep(Duration::from_secs(1)).await;
    });
    let watch = async { timeout(Duration::from_millis(100), shutdown_signal(LEAVE_WITHIN)).await };
    assert!(runtime().block_on(watch).is_err(), "an earlier signal counts");
    // As `nohup` does before it starts a program.
    // SAFETY: as above.
    unsafe { libc::signal(libc::SIGHUP, libc::SIG_IGN) };
    let quiet = runtime().block_on(async {
        let shutdown = shutdown_signal(LEAVE_WITHIN);
        send(S::HUP);
        timeout(Duration::from_secs(1), shutdown).await
    });
    assert!(quiet.is_err(), "an ignored signal counts");
}

fn runtime() -> Runtime {
    Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap()
}
