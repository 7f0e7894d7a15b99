//! Real signals, sent to this very process; so there is only this one test in the file.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::process::Command;
use std::time::Duration;

use quad_service::shutdown_signal;
use tokio::time::timeout;

#[tokio::test]
async fn either_signal_is_noticed_even_before_anybody_waits() {
    for signal in ["INT", "TERM"] {
        let shutdown = shutdown_signal();
        let status = Command::new("sh").args(["-c", &format!("kill -{signal} {}", std::process::id())]).status();
        assert!(status.unwrap().success());
        timeout(Duration::from_secs(10), shutdown).await.unwrap_or_else(|_| panic!("SIG{signal} was not noticed"));
    }
    let quiet = timeout(Duration::from_millis(100), shutdown_signal()).await;
    assert!(quiet.is_err(), "a signal of the past is no reason to leave");
}
