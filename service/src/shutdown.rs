//! The signals that end a process.

use std::pin::pin;
use std::time::{Duration, Instant};

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;
use tracing::{info, warn};

/// A process that was told to end has so long for it: less than the 10 s after which Docker kills.
const LEAVE_WITHIN: Duration = Duration::from_secs(9);
/// A second signal within this time means the same as the first: a terminal's Ctrl-C reaches a script and what it has started,
/// and then the script sends these a signal, too.
const SAME: Duration = Duration::from_millis(500);
/// The thread that writes the log gets so long for the last line.
const LAST_WORDS: Duration = Duration::from_millis(100);
/// What a shell reports of a process that SIGINT has ended.
const ENDED_AT_ONCE: i32 = 130;

/// Becomes ready at the first SIGINT (Ctrl-C) or SIGTERM after this call, even if it is not awaited by then.
///
/// From this call on, the first of the two signals does not end the process by itself any more. The next one that comes half
/// a second later or more does, at once, with exit code 130; and so does the process itself if it is still there 9 s after
/// the first, whatever it waits for. Needs a tokio runtime, and lasts as long as that.
pub fn shutdown_signal() -> impl Future<Output = ()> + Send {
    let (mut interrupt, mut terminate) = (listen(SignalKind::interrupt()), listen(SignalKind::terminate()));
    let (tell, told) = oneshot::channel();
    tokio::spawn(async move {
        let name = either(&mut interrupt, &mut terminate).await;
        let first = Instant::now();
        tell.send(()).ok();
        info!("received {name}");
        let another = async {
            loop {
                let again = either(&mut interrupt, &mut terminate).await;
                if first.elapsed() >= SAME {
                    return again;
                }
            }
        };
        match tokio::time::timeout(LEAVE_WITHIN, another).await {
            Ok(again) => warn!("received {again} after {name}: ending at once"),
            Err(_) => warn!("{} s after {name} something still hangs: ending at once", LEAVE_WITHIN.as_secs()),
        }
        tokio::time::sleep(LAST_WORDS).await;
        std::process::exit(ENDED_AT_ONCE);
    });
    async move {
        if told.await.is_err() {
            // The task above ended with its runtime, so that no signal will come.
            std::future::pending::<()>().await;
        }
    }
}

async fn either(interrupt: &mut Option<Signal>, terminate: &mut Option<Signal>) -> &'static str {
    let (interrupt, terminate) = (pin!(received(interrupt)), pin!(received(terminate)));
    tokio::select! {
        () = interrupt => "SIGINT",
        () = terminate => "SIGTERM",
    }
}

/// A signal that cannot be listened to keeps its default action: it ends the process.
fn listen(kind: SignalKind) -> Option<Signal> {
    signal(kind).inspect_err(|error| warn!("cannot prepare for a clean shutdown: {error}")).ok()
}

async fn received(signal: &mut Option<Signal>) {
    match signal {
        Some(signal) => {
            signal.recv().await;
        }
        None => std::future::pending().await,
    }
}
