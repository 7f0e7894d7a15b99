//! Gives threads that serve the network a lower priority than threads that train.

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
