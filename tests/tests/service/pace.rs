//! How fast a learner trains, and what slows it down: quiet and loud phases in turn, so that whatever else the machine does
//! meets both alike.

use std::fs;
use std::thread;
use std::time::{Duration, Instant};

use quad_tests::learner::Learner;

/// After a change between quiet and loud, this long is not counted.
pub const SETTLE: Duration = Duration::from_millis(500);

/// What was found in all phases of one kind.
pub struct Speed {
    /// Gradient steps per second: the median of the phases.
    pub steps_per_second: f64,
    /// Processor time of all threads that do not train, in seconds per second.
    pub other_threads: f64,
}

/// Lets `rounds` quiet and loud phases follow each other; `loud` begins and ends the noise. Gives the quiet pace and the loud
/// one.
pub fn compare(learner: &Learner, rounds: usize, phase: Duration, mut loud: impl FnMut(bool)) -> [Speed; 2] {
    let mut phases = [Vec::new(), Vec::new()];
    for _ in 0..rounds {
        for (kind, found) in phases.iter_mut().enumerate() {
            loud(kind == 1);
            thread::sleep(SETTLE);
            let (begin, steps, other) = (Instant::now(), steps(learner), other_threads(learner));
            thread::sleep(phase);
            let passed = begin.elapsed().as_secs_f64();
            found.push(Speed {
                steps_per_second: (self::steps(learner) - steps) / passed,
                other_threads: (other_threads(learner) - other) / passed,
            });
        }
    }
    loud(false);
    phases.map(|phases| Speed {
        steps_per_second: median(phases.iter().map(|speed| speed.steps_per_second)),
        other_threads: median(phases.iter().map(|speed| speed.other_threads)),
    })
}

fn median(numbers: impl Iterator<Item = f64>) -> f64 {
    let mut numbers: Vec<f64> = numbers.collect();
    numbers.sort_by(f64::total_cmp);
    numbers[numbers.len() / 2]
}

fn steps(learner: &Learner) -> f64 {
    learner.metric("gradient_steps_total", "").expect("the learner runs")
}

/// Processor time of the threads that do not train, seconds.
fn other_threads(learner: &Learner) -> f64 {
    let tasks = format!("/proc/{}/task", learner.process.id());
    let times = fs::read_dir(tasks).expect("it runs").filter_map(|task| {
        // A thread may end meanwhile.
        let task = task.ok()?.path();
        let name = fs::read_to_string(task.join("comm")).ok()?;
        let time = fs::read_to_string(task.join("schedstat")).ok()?;
        let nanoseconds: f64 = time.split(' ').next()?.parse().ok()?;
        // The pool's threads are called after the one that makes it.
        (!["training", "learner"].contains(&name.trim())).then_some(nanoseconds / 1e9)
    });
    times.sum()
}
