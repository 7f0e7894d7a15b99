//! Schedules of whole runs, each from a seed. A failure prints the seed, and a trace.
//!
//! - `SIMULATION_SEED=7` runs one seed, and prints its trace in any case.
//! - `SIMULATION_SECONDS=600` runs fresh seeds for ten minutes.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::print_stderr)]

use std::io::Write;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use quad_simulation::{run, trace};

/// Most lines of a trace that are printed.
const MOST_LINES: usize = 400;

fn variable(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| text.parse().expect("it is a whole number"))
}

fn print_trace(seed: u64) -> Result<(), String> {
    let (settings, trace, result) = trace(seed);
    eprintln!("seed {seed}: {settings}");
    let skipped = trace.len().saturating_sub(MOST_LINES);
    eprintln!("({skipped} lines before)");
    trace[skipped..].iter().for_each(|line| eprintln!("{line}"));
    result
}

#[test]
fn any_schedule_of_any_run_ends_with_the_same_weights_and_scores() {
    if let Some(seed) = variable("SIMULATION_SEED") {
        return print_trace(seed).unwrap();
    }
    let seconds = variable("SIMULATION_SECONDS").unwrap_or(10);
    let (begin, limit) = (Instant::now(), Duration::from_secs(seconds));
    let first: u64 = rand::random::<u64>() >> 16;
    let (next, has_failed) = (AtomicU64::new(first), AtomicBool::new(false));
    let failed = std::thread::scope(|scope| {
        let work = || {
            while begin.elapsed() < limit && !has_failed.load(Ordering::Relaxed) {
                let seed = next.fetch_add(1, Ordering::Relaxed);
                if let Err(error) = run(seed) {
                    has_failed.store(true, Ordering::Relaxed);
                    return Some((seed, error));
                }
            }
            None
        };
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        let workers = Vec::from_iter((0..threads).map(|_| scope.spawn(work)));
        workers.into_iter().find_map(|worker| worker.join().unwrap())
    });
    let count = next.load(Ordering::Relaxed) - first;
    if let Some((seed, error)) = failed {
        print_trace(seed).ok();
        panic!(
            "{error}; schedule {} of this run, SIMULATION_SEED={seed} repeats it",
            seed - first + 1
        );
    }
    // Not by `eprintln!`, which tests capture.
    writeln!(std::io::stderr(), "{count} schedules in {seconds} s, from seed {first}").unwrap();
}
