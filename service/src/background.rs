//! Threads that talk to others step back behind those that compute.

/// On a processor that is busy, a thread of this niceness gets about a tenth of what one that computes gets.
const NICENESS: i32 = 10;

/// Lets the calling thread, and those that it starts from now on, go second where processors are busy. Whoever floods a
/// learner with messages then waits himself, and training hardly does.
///
/// It is a compromise: where training takes every processor, claims wait some milliseconds longer. With less than a tenth, five
/// hundred honest evaluators are too many for one processor, and a router that cannot get rid of its messages holds up everybody.
pub fn stay_in_background() {
    // On Linux this is about the thread; elsewhere it would be about the process.
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::setpriority_process(None, NICENESS) {
        tracing::debug!(%error, "the priority of a thread could not be lowered");
    }
}
