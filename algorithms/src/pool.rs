//! The thread pool, kept awake.

use rayon::Yield;
use std::hint::spin_loop;
use std::sync::atomic::{AtomicBool, Ordering};

/// Spins between two looks for work: enough not to disturb the thread that hands it out.
const PAUSES: usize = 50;

/// Runs `work` as a whole on a thread of the pool, and keeps the others looking for work meanwhile.
///
/// A gradient step has some fifteen parallel parts with microseconds of other work between them.
/// Handing each of them to the pool from outside, or letting idle threads fall asleep in between,
/// costs as much as that other work itself.
pub(crate) fn run_awake<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    let done = AtomicBool::new(false);
    rayon::scope(|scope| {
        // Set however `work` ends, so that no thread looks forever.
        let _ending = SetWhenDropped(&done);
        for _ in 1..rayon::current_num_threads() {
            scope.spawn(|_| {
                while !done.load(Ordering::Relaxed) {
                    if rayon::yield_now() != Some(Yield::Executed) {
                        (0..PAUSES).for_each(|_| spin_loop());
                    }
                }
            });
        }
        work()
    })
}

struct SetWhenDropped<'a>(&'a AtomicBool);

impl Drop for SetWhenDropped<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rayon::prelude::*;

    #[test]
    fn parallel_parts_run_within_and_a_panic_comes_through() {
        let sum: u64 = run_awake(|| (0..1000_u64).into_par_iter().map(|x| x * x).sum());
        assert_eq!(sum, 332_833_500);
        let panicked = std::panic::catch_unwind(|| run_awake(|| panic!("on purpose")));
        assert!(panicked.is_err(), "the threads that look for work must end, too");
    }
}
