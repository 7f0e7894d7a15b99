//! The service in a simulation: one learner and up to 64 evaluators as state machines, with virtual
//! time, a network, a disk and strangers. Every choice follows from a seed; a failure prints it, and
//! a trace.
//!
//! - `SIMULATION_SEED=7` runs one seed, and prints its trace in any case.
//! - `SIMULATION_SECONDS=600` runs fresh seeds for ten minutes.
//!
//! What must hold for any schedule: each episode of an evaluation counts once, with the first bits
//! that are on the disk; each online episode is recorded once; training takes them in their order, so
//! that its weights are those of a run without faults; nothing that was acknowledged is lost; and the
//! run ends.

#![allow(missing_docs, clippy::expect_used, clippy::unwrap_used, clippy::print_stderr)]

mod arithmetic;
mod disk;
mod evaluator;
mod learner;
mod network;
mod settings;
mod strangers;
mod training;
mod world;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use world::World;

/// Most lines of a trace that are printed.
const MOST_LINES: usize = 400;

fn variable(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|text| text.parse().expect("it is a whole number"))
}

/// Runs a seed. An error says what does not hold.
fn run(seed: u64) -> Result<(), String> {
    let run = catch_unwind(|| World::new(seed, false).run());
    run.unwrap_or_else(|_| Err("it panicked".to_owned()))
}

fn print_trace(seed: u64) -> Result<(), String> {
    let mut world = World::new(seed, true);
    let result = catch_unwind(AssertUnwindSafe(|| world.run()));
    let result = result.unwrap_or_else(|_| Err("it panicked".to_owned()));
    let trace = world.trace.unwrap_or_default();
    eprintln!("seed {seed}: {:#?}", world.settings);
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
    eprintln!("{count} schedules in {seconds} s, from seed {first}");
}
