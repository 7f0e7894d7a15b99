//! Threads that serve the network step back behind those that train.

/// On a busy processor, a thread of this niceness gets about a tenth of the time of one that trains.
const NICENESS: i32 = 10;

/// Gives the calling thread, and those that it starts from now on, less time where processors are busy, so that messages
/// hardly slow down training.
///
/// It is a compromise: where training takes every processor, an evaluator waits some milliseconds longer for a job.
pub fn stay_in_background() {
    // On Linux this is about the thread; elsewhere it would be about the process.
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(None, NICENESS) {
        tracing::debug!(%error, "the priority of a thread could not be lowered");
    }
}
