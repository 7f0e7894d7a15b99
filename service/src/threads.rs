//! How many threads Zenoh and candle use. Both read it from the environment, once, when they are first used.

use std::env;

/// Of Zenoh, the threads that receive (`rx`) also watch connections and timers, which otherwise have threads of their own: to
/// wake a thread takes more of a processor than what it then does for a small message.
/// Two threads send (`tx`): while Zenoh closes the connection of a peer that does not read, one of them waits for two seconds.
const ZENOH: (&str, &str) = ("ZENOH_RUNTIME", "(app: (handover: rx), net: (handover: rx), tx: (worker_threads: 2))");
/// Candle has a pool of its own for what it does to tensors of 65,536 numbers or more, beside Rayon's, and waits in a loop
/// for it. The learner keeps Rayon's threads awake, so that the two would take turns: a step would take twenty times as long.
const CANDLE: (&str, &str) = ("CANDLE_NUM_THREADS", "1");

/// Limits the threads of both, unless the user has set these variables.
///
/// To be called at the start of `main`, before there are other threads.
pub fn choose_threads() {
    for (variable, threads) in [ZENOH, CANDLE] {
        if env::var_os(variable).is_none() {
            // SAFETY: this is the only thread, so no other one reads the environment at the same time.
            #[allow(unsafe_code)]
            unsafe {
                env::set_var(variable, threads);
            }
        }
    }
}
