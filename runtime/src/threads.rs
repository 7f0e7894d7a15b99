//! Numbers and priorities of threads. Zenoh, candle and rayon read theirs from the environment.

use std::env;
use std::num::NonZero;

/// Zenoh's threads that receive (`rx`) also do the work of its threads for connections and timers:
/// waking another thread costs more than handling a small message. Two threads send (`tx`): while
/// Zenoh closes the connection of a peer that does not read, one of them waits for two seconds.
const ZENOH: (&str, &str) =
    ("ZENOH_RUNTIME", "(app: (handover: rx), net: (handover: rx), tx: (worker_threads: 2))");
/// Besides Rayon's pool, candle has a pool of its own for tensors of 65,536 numbers or more, and
/// spins while it waits for it. The learner keeps Rayon's threads awake, so the two pools would
/// take turns on the cores, and a step would take twenty times as long.
const CANDLE: (&str, &str) = ("CANDLE_NUM_THREADS", "1");

/// Limits the threads of Zenoh and candle, unless the user has set the variables. Call it at the start
/// of `main`, before there are other threads.
pub fn choose_threads() {
    for (variable, threads) in [ZENOH, CANDLE] {
        if env::var_os(variable).is_none() {
            // SAFETY: this is the only thread, so no other thread reads the environment at the same
            // time.
            #[allow(unsafe_code)]
            unsafe {
                env::set_var(variable, threads);
            }
        }
    }
}

/// The user's number of rayon threads, by RAYON_NUM_THREADS; `None` if it is unset, 0 or no number.
pub fn requested_threads() -> Option<NonZero<usize>> {
    env::var("RAYON_NUM_THREADS").ok()?.parse().ok()
}

/// A thread of this niceness gets about a tenth of the processor time of a thread that trains.
const NICENESS: i32 = 10;

/// Lowers the priority of the calling thread and of threads that it starts later, so that messages
/// hardly slow down training. If training uses every core, an evaluator waits some milliseconds
/// longer for a job.
pub fn stay_in_background() {
    // On Linux this changes the thread; on other systems it would change the process.
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(None, NICENESS) {
        tracing::debug!(%error, "the priority of a thread could not be lowered");
    }
}
