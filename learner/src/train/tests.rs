//! Tests of the training loop: its output and its end.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use candle_core::Device;
use prometheus::proto::MetricFamily;
use quad_algorithms::{Agent, Context};
use quad_dataset::{Arrays, BatchSampler, Transitions, Window};
use quad_policy::Precision;
use quad_run::config::hyperparameters::algorithm as definition;
use quad_run::config::{Schedule, resolve};
use quad_run::folder::Checkpoint;
use quad_runtime::{Health, Heartbeat};

use super::TrainingMetrics;
use super::agent::origin;
use super::held_out::HeldOut;
use super::output_queue::{Output, OutputQueue};
use super::results::{Outcome, Row};
use super::training::{TrainError, Training};

mod held_out;
mod online;
mod output_queue;
mod phases;

struct Trained {
    outcome: Result<Outcome, TrainError>,
    /// Step, and whether it is to be evaluated.
    snapshots: Vec<(u64, bool)>,
    checkpoint: Option<Checkpoint>,
    rows: Vec<Row>,
    metrics: TrainingMetrics,
    /// Names of the gauges and counters that have a value at the end.
    gauges: BTreeSet<String>,
}

fn beat() -> Heartbeat {
    Health::default().register("training", Duration::from_secs(60))
}

/// Hopper's observation and action.
const DIMS: (usize, usize) = (11, 3);

/// 30 transitions in one episode that is cut off.
fn one_episode(observations: Vec<f32>, rewards: Vec<f32>) -> Transitions {
    let actions = (0..30 * DIMS.1).map(|i| (i as f32).sin() / 2.0);
    Transitions::of(Arrays {
        observation_dim: DIMS.0,
        action_dim: DIMS.1,
        next_observations: observations.iter().map(|x| 0.5 * x.min(1.0)).collect(),
        observations,
        actions: actions.collect(),
        rewards,
        terminals: vec![false; 30],
        timeouts: (1..=30).map(|row| row == 30).collect(),
    })
    .unwrap()
}

fn transitions() -> Transitions {
    let observations = (0..30 * DIMS.0).map(|i| (i as f32).sin() / 2.0);
    one_episode(observations.collect(), vec![1.0; 30])
}

/// Hyper-parameters of the demonstration with small networks.
fn small(algorithm: &str) -> toml::Table {
    let asked = toml::Table::from_iter([("algorithm".to_owned(), algorithm.into())]);
    let mut table = resolve("hopper-demo", &asked).unwrap().agent;
    for (_, layers) in table.iter_mut() {
        if let Some(hidden) = layers.get_mut("hidden") {
            *hidden = vec![8, 8].into();
        }
    }
    table
}

fn context(total_steps: u64) -> Context {
    Context {
        transitions: Arc::new(transitions()),
        total_steps,
        online_steps: 0,
        window: Window::ONE,
        seed: 0,
        precision: Precision::F32,
        device: Device::Cpu,
    }
}

const fn schedule(steps: u64, eval_interval: u64) -> Schedule {
    Schedule { start: 0, steps, eval_interval }
}

fn agent(algorithm: &str, total_steps: u64) -> Agent {
    Agent::new(definition(algorithm).unwrap(), &small(algorithm), context(total_steps)).unwrap()
}

fn run(agent: Agent, schedule: Schedule) -> Trained {
    run_with(agent, schedule, |_| {})
}

/// Trains with a checkpoint after every step, and with these changes.
fn run_with(agent: Agent, schedule: Schedule, change: impl FnOnce(&mut Training)) -> Trained {
    let registry = prometheus::Registry::new();
    let metrics = TrainingMetrics::new(&registry, schedule.steps, agent.metrics()).unwrap();
    let examples = agent.examples(Arc::new(transitions())).unwrap();
    let mut training = Training {
        sampler: BatchSampler::new(examples.len(), 4, 0, agent.step()),
        examples,
        agent,
        online: None,
        held_out: None,
        schedule,
        origin: origin(&resolve("hopper-demo", &toml::Table::new()).unwrap()),
        checkpoint_every: Duration::ZERO,
        seconds_before: 0.0,
        metrics: metrics.clone(),
        queue: OutputQueue::default(),
        stop: Arc::default(),
    };
    change(&mut training);
    // Nothing takes the output, as with a disk that hangs: training must end all the same.
    let outcome = training.train(&beat());
    let families = registry.gather();
    let name = |family: &MetricFamily| family.name().replace("quad_learner_", "");
    let gauges = families.iter().map(name).collect();
    let (snapshots, checkpoint, rows) = (Vec::new(), None, Vec::new());
    let mut trained = Trained { outcome, snapshots, checkpoint, rows, metrics, gauges };
    training.queue.close();
    while let Some(output) = training.queue.next(&beat()) {
        match output {
            Output::Snapshot(policy) => trained.snapshots.push((policy.step, policy.evaluate)),
            Output::Checkpoint(checkpoint) => trained.checkpoint = Some(checkpoint),
            Output::Rows(rows) => trained.rows.extend(rows),
            Output::Online(_) | Output::Waits(_) | Output::Ended(_) => {
                panic!("the loop does not send this")
            }
        }
    }
    trained
}

#[test]
fn snapshots_come_at_every_interval_and_at_the_end() {
    let trained = run(agent("quad", 25), schedule(25, 10));
    assert_eq!(trained.outcome.unwrap(), Outcome::Completed);
    assert_eq!(trained.snapshots, [(10, true), (20, true), (25, true)]);
    assert_eq!(trained.metrics.gradient_steps.get(), 25);
    assert_eq!(trained.metrics.step_duration.get_sample_count(), 25);
    assert_eq!(
        run(agent("quad", 25), schedule(25, 0)).snapshots,
        [(25, false)],
        "without evaluations"
    );
}

#[test]
fn a_stop_ends_after_the_step_with_a_checkpoint() {
    let trained = run_with(agent("quad", 25), schedule(25, 10), |training| {
        training.stop = Arc::new(true.into())
    });
    assert_eq!(trained.outcome.unwrap(), Outcome::Stopped);
    assert_eq!(trained.snapshots, []);
    assert_eq!(trained.checkpoint.unwrap().step, 1);
}

#[test]
fn training_resumes_from_a_checkpoint_bit_for_bit() {
    for algorithm in ["quad", "iql"] {
        let whole = run(agent(algorithm, 300), schedule(300, 100));
        for stop_at in [1, 99, 100, 250] {
            let first = run(agent(algorithm, 300), schedule(stop_at, 100));
            let mut resumed = agent(algorithm, 300);
            resumed.load(&first.checkpoint.unwrap().state).unwrap();
            let rest = run(resumed, schedule(300, 100));
            assert!(rest.checkpoint == whole.checkpoint, "after step {stop_at}");
            let later = whole.snapshots.iter().filter(|(step, _)| *step > stop_at);
            assert!(rest.snapshots.iter().eq(later), "after step {stop_at}");
        }
    }
}

#[test]
fn divergence_is_an_error_with_step_and_metric() {
    for algorithm in ["quad", "iql"] {
        let mut table = small(algorithm);
        table.insert("critic_learning_rate".to_owned(), 1e30.into());
        let agent = Agent::new(definition(algorithm).unwrap(), &table, context(25)).unwrap();
        let trained = run(agent, schedule(25, 10));
        let error = trained.outcome.unwrap_err();
        assert!(matches!(error, TrainError::Diverged { step: 1..10, .. }), "{error}");
        assert!(trained.snapshots.is_empty(), "no broken policy is evaluated");
    }
}

/// Losses and weights stay finite where a gradient is too large to be squared.
#[test]
fn a_state_that_cannot_be_saved_leaves_no_snapshot_of_its_step() {
    let mut outlier = vec![0.5; 30 * DIMS.0];
    outlier[0] = 1e12;
    let trained = run_with(agent("td3-bc", 25), schedule(25, 1), |training| {
        let transitions = one_episode(outlier, vec![1.0; 30]);
        training.examples = training.agent.examples(Arc::new(transitions)).unwrap();
        training.sampler = BatchSampler::new(30, 4, 0, 0);
    });
    let error = trained.outcome.unwrap_err();
    let TrainError::Diverged { step, what } = error else { panic!("{error}") };
    assert!(what.contains("adam"), "{what}");
    let before = (1..step).map(|step| (step, true));
    assert_eq!(trained.snapshots, Vec::from_iter(before));
}
