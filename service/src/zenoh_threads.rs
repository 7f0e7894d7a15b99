//! How many threads Zenoh uses.

use std::env;

/// Zenoh reads this once, when it is first used.
const VARIABLE: &str = "ZENOH_RUNTIME";
/// The threads that receive (`rx`) also watch connections and timers, which otherwise have threads of their own: to wake a
/// thread takes more of a processor than what it then does for a small message.
/// Two threads send (`tx`): while Zenoh closes the connection of a peer that does not read, one of them waits for two seconds.
const THREADS: &str = "(app: (handover: rx), net: (handover: rx), tx: (worker_threads: 2))";

/// Limits Zenoh's threads, unless the user has set `ZENOH_RUNTIME`.
///
/// To be called at the start of `main`, before there are other threads.
pub fn choose_zenoh_threads() {
    if env::var_os(VARIABLE).is_none() {
        // SAFETY: this is the only thread, so no other one reads the environment at the same time.
        #[allow(unsafe_code)]
        unsafe {
            env::set_var(VARIABLE, THREADS);
        }
    }
}
