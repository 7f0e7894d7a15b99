//! The signals that end a process.

use std::pin::pin;

use tokio::signal::unix::{Signal, SignalKind, signal};
use tracing::{info, warn};

/// Becomes ready at the first SIGINT (Ctrl-C) or SIGTERM after this call, even if it is not awaited by then.
///
/// From this call on, the two signals do not end the process by themselves any more. Needs a tokio runtime.
pub fn shutdown_signal() -> impl Future<Output = ()> + Send {
    let (interrupt, terminate) = (listen(SignalKind::interrupt()), listen(SignalKind::terminate()));
    async move {
        let (interrupt, terminate) = (pin!(received(interrupt)), pin!(received(terminate)));
        let name = tokio::select! {
            () = interrupt => "SIGINT",
            () = terminate => "SIGTERM",
        };
        info!("received {name}");
    }
}

/// A signal that cannot be listened to keeps its default action: it ends the process.
fn listen(kind: SignalKind) -> Option<Signal> {
    signal(kind).inspect_err(|error| warn!("cannot prepare for a clean shutdown: {error}")).ok()
}

async fn received(signal: Option<Signal>) {
    match signal {
        Some(mut signal) => {
            signal.recv().await;
        }
        None => std::future::pending().await,
    }
}
