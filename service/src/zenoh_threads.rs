//! How Zenoh shares its work among threads.

use std::env;

/// Zenoh reads this once, when it is first used.
const VARIABLE: &str = "ZENOH_RUNTIME";
/// The threads that receive also do what would be the work of two more: watching the connections that this process opened, and
/// timers. By itself, Zenoh wakes three threads for a question, one after the other, before it is even asked.
/// Two threads send: when Zenoh closes the connection of a peer that is still being sent to, one of them waits for that sender,
/// and nothing else would be sent for two seconds.
const THREADS: &str = "(app: (handover: rx), net: (handover: rx), tx: (worker_threads: 2))";

/// Lets Zenoh do with these threads, unless the user has chosen how many in `ZENOH_RUNTIME`: to wake one takes more of a
/// processor that training needs than what it then does for a small message.
///
/// To be called at the start of `main`, before there are other threads.
pub fn choose_zenoh_threads() {
    if env::var_os(VARIABLE).is_none() {
        // SAFETY: nobody reads the environment meanwhile, because there is no other thread yet.
        #[allow(unsafe_code)]
        unsafe {
            env::set_var(VARIABLE, THREADS);
        }
    }
}
