//! The signals that end a process.

use std::future::poll_fn;
use std::task::Poll;
use std::time::{Duration, Instant};

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;
use tracing::{info, warn};

use crate::exit::{ENDED_AT_ONCE, UNFINISHED};

/// A process that was told to end has this long for it: less than the 10 s after which Docker kills
/// it.
pub const LEAVE_WITHIN: Duration = Duration::from_secs(9);
/// A second signal within this time counts as the first: a terminal's Ctrl-C reaches a script and
/// its children, and the script may then send them a signal, too.
const SAME: Duration = Duration::from_millis(500);
/// How long the thread that writes the log has for its last line.
const LAST_WORDS: Duration = Duration::from_millis(100);

/// Becomes ready at the first signal to end after this call, even before a task awaits it: SIGINT
/// (Ctrl-C), SIGTERM, SIGHUP (the end of a terminal's session), or SIGUSR1 (what Slurm's `--signal`
/// sends before a time limit). Of SIGHUP and SIGUSR1, one that was ignored when the process began
/// stays so: that is what `nohup` is for.
///
/// Takes over these signals: the first no longer ends the process. A further signal, half a second
/// later or more, ends it at once with exit code 130. All that the process does to end shares one
/// budget: this long after the first signal it ends, whatever it waits for, with exit code 75,
/// because the same command continues its work. Needs a tokio runtime, and lasts as long as that
/// runtime.
pub fn shutdown_signal(within: Duration) -> impl Future<Output = ()> + Send {
    let mut signals = listen();
    let (tell, told) = oneshot::channel();
    tokio::spawn(async move {
        let name = first_of(&mut signals).await;
        let first = Instant::now();
        tell.send(()).ok();
        info!("received {name}");
        let another = async {
            loop {
                let again = first_of(&mut signals).await;
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
                warn!(
                    "{} s after {name} something has not ended: ending without it",
                    within.as_secs()
                );
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

/// The name of the first of these signals that comes.
async fn first_of(signals: &mut [(&'static str, Signal)]) -> &'static str {
    poll_fn(|context| {
        let come = |(name, signal): &mut (_, Signal)| {
            signal.poll_recv(context).is_ready().then_some(*name)
        };
        signals.iter_mut().find_map(come).map_or(Poll::Pending, Poll::Ready)
    })
    .await
}

/// Takes over the signals. One for which no handler can be set keeps its default action: it ends
/// the process.
fn listen() -> Vec<(&'static str, Signal)> {
    let always = [("SIGINT", SignalKind::interrupt()), ("SIGTERM", SignalKind::terminate())];
    let unless_ignored =
        [("SIGHUP", SignalKind::hangup()), ("SIGUSR1", SignalKind::user_defined1())];
    let kinds =
        always.into_iter().chain(unless_ignored.into_iter().filter(|(_, kind)| !is_ignored(*kind)));
    let prepared = kinds.filter_map(|(name, kind)| match signal(kind) {
        Ok(signal) => Some((name, signal)),
        Err(error) => {
            warn!("cannot prepare for a clean shutdown by {name}: {error}");
            None
        }
    });
    prepared.collect()
}

/// Whether the process ignores a signal, as one that `nohup` has started ignores SIGHUP.
fn is_ignored(kind: SignalKind) -> bool {
    // SAFETY: it changes nothing, and writes what is set into a structure of the type that it
    // takes.
    #[allow(unsafe_code)]
    unsafe {
        let mut set: libc::sigaction = std::mem::zeroed();
        libc::sigaction(kind.as_raw_value(), std::ptr::null(), &mut set) == 0
            && set.sa_sigaction == libc::SIG_IGN
    }
}
