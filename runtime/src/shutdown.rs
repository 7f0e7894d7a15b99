//! The signals that end a process.

use std::pin::pin;
use std::time::{Duration, Instant};

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;
use tracing::{info, warn};

use crate::exit::{ENDED_AT_ONCE, UNFINISHED};

/// A process that was told to end has this long for it: less than the 10 s after which Docker kills it.
pub const LEAVE_WITHIN: Duration = Duration::from_secs(9);
/// A second signal within this time counts as the first: a terminal's Ctrl-C reaches a script and its children, and the script
/// may then send them a signal, too.
const SAME: Duration = Duration::from_millis(500);
/// How long the thread that writes the log has for its last line.
const LAST_WORDS: Duration = Duration::from_millis(100);

/// Becomes ready at the first SIGINT (Ctrl-C) or SIGTERM after this call, even before a task awaits it.
///
/// Takes over the two signals: the first no longer ends the process. A further signal, half a second later or more,
/// ends it at once with exit code 130. All that the process does to end shares one budget: this long after the first signal it
/// ends, whatever it waits for, with exit code 75, because the same command continues its work. Needs a tokio runtime, and
/// lasts as long as that runtime.
pub fn shutdown_signal(within: Duration) -> impl Future<Output = ()> + Send {
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
        let code = match tokio::time::timeout(within, another).await {
            Ok(again) => {
                warn!("received {again} after {name}: ending at once");
                ENDED_AT_ONCE
            }
            Err(_) => {
                warn!("{} s after {name} something has not ended: ending without it", within.as_secs());
                UNFINISHED
            }
        };
        tokio::time::sleep(LAST_WORDS).await;
        std::process::exit(code.into());
    });
    async move {
        if told.await.is_err() {
            // The task above ended with its runtime, so no signal will come.
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

/// A signal for which no handler can be set keeps its default action: it ends the process.
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
