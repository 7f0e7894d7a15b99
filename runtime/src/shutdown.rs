//! The signals that end a process.

use std::future::poll_fn;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Poll;
use std::time::{Duration, Instant};

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;
use tracing::{info, warn};

use crate::exit::{ENDED_AT_ONCE, UNFINISHED};

/// Time limit of a shutdown: less than the 10 s after which Docker kills a process.
pub const LEAVE_WITHIN: Duration = Duration::from_secs(9);
/// A second signal within this time counts as the first: Ctrl-C reaches a script and its children,
/// and the script may then send them a signal, too.
const SAME: Duration = Duration::from_millis(500);
/// Time for the thread that writes the log.
const LAST_WORDS: Duration = Duration::from_millis(100);

/// True once a [`shutdown_signal`] takes the signals.
static IS_TAKEN: AtomicBool = AtomicBool::new(false);

/// Until the first [`shutdown_signal`], its signals end the process at once with exit code 75. Call
/// it where the work begins that the same command continues.
pub fn unfinished_at_signal() {
    extern "C" fn leave(_: libc::c_int) {
        if !IS_TAKEN.load(Ordering::Relaxed) {
            // SAFETY: a handler may end the process so.
            #[allow(unsafe_code)]
            unsafe {
                libc::_exit(UNFINISHED.into())
            }
        }
    }
    let handler: extern "C" fn(libc::c_int) = leave;
    for (_, kind) in kinds() {
        // SAFETY: the handler does only what one may do.
        #[allow(unsafe_code)]
        unsafe {
            libc::signal(kind.as_raw_value(), handler as libc::sighandler_t);
        }
    }
}

/// Becomes ready at the first signal to end after this call, even before a task awaits it: SIGINT
/// (Ctrl-C), SIGTERM, SIGHUP (the end of a terminal's session), or SIGUSR1 (what Slurm's `--signal`
/// sends before a time limit). Of SIGHUP and SIGUSR1, one that was ignored when the process began
/// stays ignored, as `nohup` needs.
///
/// The first signal no longer ends the process. A further signal, half a second later or more, ends it
/// at once with exit code 130. `within` after the first signal, the process ends with exit code 75,
/// because the same command continues its work. Needs a tokio runtime, and lasts as long as it.
pub fn shutdown_signal(within: Duration) -> impl Future<Output = ()> + Send {
    let mut signals = listen();
    let (tx, rx) = oneshot::channel();
    tokio::spawn(async move {
        let name = first_of(&mut signals).await;
        let first = Instant::now();
        tx.send(()).ok();
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
                let seconds = within.as_secs();
                warn!("{seconds} s after {name} something has not ended: ending without it");
                UNFINISHED
            }
        };
        tokio::time::sleep(LAST_WORDS).await;
        std::process::exit(code.into());
    });
    async move {
        if rx.await.is_err() {
            // The task above ended with its runtime, so no signal will come.
            std::future::pending::<()>().await;
        }
    }
}

/// Waits for a signal and returns its name.
async fn first_of(signals: &mut [(&'static str, Signal)]) -> &'static str {
    poll_fn(|context| {
        let come = |(name, signal): &mut (_, Signal)| {
            signal.poll_recv(context).is_ready().then_some(*name)
        };
        signals.iter_mut().find_map(come).map_or(Poll::Pending, Poll::Ready)
    })
    .await
}

/// Sets handlers. A signal whose handler cannot be set keeps its default action: it ends the process.
fn listen() -> Vec<(&'static str, Signal)> {
    let mut prepared = Vec::new();
    for (name, kind) in kinds() {
        match signal(kind) {
            Ok(signal) => prepared.push((name, signal)),
            Err(error) => warn!("cannot prepare for a clean shutdown by {name}: {error}"),
        }
    }
    // A handler set before is called first.
    IS_TAKEN.store(true, Ordering::Relaxed);
    prepared
}

/// The signals to end, without those that the process is to ignore.
fn kinds() -> impl Iterator<Item = (&'static str, SignalKind)> {
    let kinds = [
        ("SIGINT", SignalKind::interrupt(), false),
        ("SIGTERM", SignalKind::terminate(), false),
        ("SIGHUP", SignalKind::hangup(), true),
        ("SIGUSR1", SignalKind::user_defined1(), true),
    ];
    let heeded = |(name, kind, may_be_ignored): (_, SignalKind, bool)| {
        (!may_be_ignored || !is_ignored(kind)).then_some((name, kind))
    };
    kinds.into_iter().filter_map(heeded)
}

/// True if the process ignores a signal, as `nohup` makes it ignore SIGHUP.
fn is_ignored(kind: SignalKind) -> bool {
    // SAFETY: with a null new action, sigaction only writes the current action to `set`.
    #[allow(unsafe_code)]
    unsafe {
        let mut set: libc::sigaction = std::mem::zeroed();
        libc::sigaction(kind.as_raw_value(), std::ptr::null(), &mut set) == 0
            && set.sa_sigaction == libc::SIG_IGN
    }
}
