//! A run, its machines and their faults, all drawn from a seed.

use std::time::Duration;

use quad_run::config::{Online, Schedule};
use rand::Rng;
use rand::rngs::StdRng;

/// Everything that a schedule begins with.
#[derive(Clone, Debug)]
pub struct Settings {
    pub schedule: Schedule,
    /// Gradient steps before the first online.
    pub offline_steps: u64,
    pub online: Option<Online>,
    /// Episodes of an evaluation.
    pub episodes: u32,
    pub job_episodes: [usize; 2],
    pub lease: Duration,
    /// Duration of a gradient step.
    pub gradient_step: Duration,
    /// Numbers of an observation; large ones make an episode of several pieces.
    pub observation_dim: usize,
    pub evaluators: usize,
    pub faults: Faults,
}

/// Probabilities are of each message, operation or step; nothing fails after `until`.
#[derive(Clone, Debug)]
pub struct Faults {
    pub until: Duration,
    pub lost: f64,
    pub doubled: f64,
    /// Longest delay of a message.
    pub delay: Duration,
    /// Mean time between two faults of each kind; `None` if there are none.
    pub learner_crashes: Option<Duration>,
    pub evaluator_crashes: Option<Duration>,
    pub evaluator_leaves: Option<Duration>,
    pub partitions: Option<Duration>,
    pub disk_failures: Option<Duration>,
    pub strangers: Option<Duration>,
    /// Time after which no evaluator is there, nor will be.
    pub desertion: Option<Duration>,
    /// Probability that a job hangs, or fails.
    pub hangs: f64,
    pub failures: f64,
    /// True if evaluators have different arithmetic: the same episode has other bits.
    pub other_bits: bool,
}

fn seconds(rng: &mut StdRng, least: f64, most: f64) -> Duration {
    Duration::from_secs_f64(rng.random_range(least..most))
}

/// One of the values, the first half of the time.
fn mostly<T>(rng: &mut StdRng, usual: T, other: T) -> T {
    if rng.random_bool(0.5) { usual } else { other }
}

impl Settings {
    pub fn draw(rng: &mut StdRng) -> Self {
        let offline_steps = rng.random_range(1..12);
        let online = rng.random_bool(0.6).then(|| {
            let steps = rng.random_range(4..24);
            Online {
                steps,
                updates_per_step: rng.random_range(1..3),
                warmup: rng.random_range(0..steps / 2),
                uniform_warmup: rng.random(),
                share: None,
                noise: 0.1,
                lag: rng.random_range(1..4),
                snapshot_interval: rng.random_range(1..8),
            }
        });
        let updates = online.as_ref().map_or(0, |online| online.updates_after(u64::MAX));
        let steps = offline_steps + updates;
        let evaluators = match rng.random_range(0..40) {
            0 => rng.random_range(9..65),
            1..6 => rng.random_range(4..9),
            _ => rng.random_range(1..4),
        };
        let mut faults = Faults::draw(rng);
        if online.is_none() && rng.random_bool(0.03) {
            // A run with online episodes would wait for ever.
            faults.desertion = Some(seconds(rng, 0.0, 60.0));
            faults.strangers = None;
        }
        Self {
            schedule: Schedule { start: 0, steps, eval_interval: rng.random_range(1..=steps) },
            offline_steps,
            online,
            episodes: rng.random_range(1..5),
            job_episodes: [rng.random_range(1..4), 4],
            lease: seconds(rng, 5.0, 60.0),
            gradient_step: seconds(rng, 0.01, 2.0),
            observation_dim: if rng.random_bool(0.02) { 3000 } else { 2 },
            evaluators,
            faults,
        }
    }
}

impl Faults {
    /// A world in which nothing fails.
    const NONE: Self = Self {
        until: Duration::ZERO,
        lost: 0.0,
        doubled: 0.0,
        delay: Duration::ZERO,
        learner_crashes: None,
        evaluator_crashes: None,
        evaluator_leaves: None,
        partitions: None,
        disk_failures: None,
        strangers: None,
        desertion: None,
        hangs: 0.0,
        failures: 0.0,
        other_bits: false,
    };

    fn draw(rng: &mut StdRng) -> Self {
        if rng.random_bool(0.05) {
            return Self::NONE;
        }
        let mut every = |least, most| {
            let mean = seconds(rng, least, most);
            rng.random_bool(0.4).then_some(mean)
        };
        let learner_crashes = every(5.0, 60.0);
        let evaluator_crashes = every(5.0, 60.0);
        let evaluator_leaves = every(5.0, 60.0);
        let partitions = every(5.0, 60.0);
        let disk_failures = every(5.0, 60.0);
        let strangers = every(0.5, 10.0);
        Self {
            until: seconds(rng, 1.0, 90.0),
            lost: mostly(rng, 0.0, 0.1),
            doubled: mostly(rng, 0.0, 0.1),
            delay: mostly(rng, Duration::from_millis(5), Duration::from_secs(8)),
            learner_crashes,
            evaluator_crashes,
            evaluator_leaves,
            partitions,
            disk_failures,
            strangers,
            desertion: None,
            hangs: mostly(rng, 0.0, 0.05),
            failures: mostly(rng, 0.0, 0.05),
            other_bits: rng.random_bool(0.1),
        }
    }
}
