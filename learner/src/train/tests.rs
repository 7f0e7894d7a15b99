//! Tests of the training loop: its output and its end.

use std::collections::BTreeSet;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use candle_core::Device;
use prometheus::proto::MetricFamily;
use quad_algorithms::{
    Agent, Algorithm, Batch, Columns, Context, Definition, Measured, Metric, Start, StateDict,
};
use quad_dataset::{
    Arrays, BatchSampler, ReadOptions, RewardRule, Transitions, Window, environment,
};
use quad_nn::Tensors;
use quad_policy::{GaussianShape, MlpConfig, PolicyConfig, Precision, Spread};
use quad_run::config::hyperparameters::algorithm as definition;
use quad_run::config::{Schedule, resolve};
use quad_run::folder::Checkpoint;
use quad_runtime::{Health, Heartbeat};

use super::TrainingMetrics;
use super::agent::origin;
use super::cost::mean_step;
use super::held_out::HeldOut;
use super::output_queue::{Output, OutputQueue};
use super::results::{Outcome, Row, TrainedPolicy};
use super::training::{TrainError, Training};

#[path = "../../../tests/fixtures/hopper.rs"]
mod hopper;
use hopper::write_hopper;

mod held_out;
mod online;

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

fn transitions() -> Transitions {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tiny.hdf5");
    let hopper = environment::find("hopper").unwrap();
    write_hopper(&path, 2, 50);
    let options = ReadOptions {
        environment: Some(hopper),
        reward: RewardRule::Locomotion,
        ..ReadOptions::default()
    };
    Transitions::read(&path, &options).unwrap()
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
fn rows_average_a_hundred_steps() {
    let trained = run(agent("quad", 450), schedule(450, 0));
    let steps = trained.rows.iter().map(|row| row.step);
    assert_eq!(Vec::from_iter(steps), [100, 200, 300, 400, 450]);
    for row in trained.rows {
        let json = serde_json::to_value(&row).unwrap();
        let value = |name: &str| json[name].as_f64().unwrap();
        assert_eq!(value("eta"), 1.0);
        assert!((0.0..=1.0).contains(&value("lambda_mean")) && value("bc_loss") > 0.0, "{json}");
        assert_eq!(json.as_object().unwrap().len(), 2 + row.metrics.len());
    }
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
fn a_queue_that_the_disk_does_not_empty_keeps_all_rows_then_the_newest_checkpoint() {
    let (queue, beat) = (OutputQueue::default(), beat());
    let checkpoint = |step: u64| Checkpoint { step, state: vec![step as u8] };
    for step in 1..=3 {
        let (values, held_out) = (vec![], vec![]);
        let online = Vec::new();
        let row = Row { step, seconds: 0.0, metrics: &[], values, held_out, online };
        queue.push(Output::Rows(vec![row]));
        queue.push(Output::Checkpoint(checkpoint(step)));
    }
    queue.push(Output::Ended(Outcome::Completed));
    queue.close();
    assert!(matches!(queue.next(&beat), Some(Output::Rows(rows)) if rows.len() == 3));
    assert!(
        matches!(queue.next(&beat), Some(Output::Checkpoint(newest)) if newest == checkpoint(3))
    );
    assert!(matches!(queue.next(&beat), Some(Output::Ended(Outcome::Completed))));
    assert!(queue.next(&beat).is_none());
}

/// Adds a snapshot of 150 MiB.
fn add_large(queue: &OutputQueue, step: u64, stop: bool) {
    let policy = TrainedPolicy { step, file: vec![0; 150 << 20], evaluate: true, online: false };
    queue.snapshot(policy, &AtomicBool::new(stop), &beat());
}

#[test]
fn training_waits_only_while_many_bytes_wait_for_the_disk_and_not_after_a_stop() {
    let queue = OutputQueue::default();
    add_large(&queue, 1, false);
    add_large(&queue, 2, false);
    let waits = std::thread::scope(|scope| {
        let third = scope.spawn(|| add_large(&queue, 3, false));
        std::thread::sleep(Duration::from_millis(200));
        let waits = !third.is_finished();
        assert!(matches!(queue.next(&beat()), Some(Output::Snapshot(first)) if first.step == 1));
        waits
    });
    assert!(waits, "300 MiB are too many");
    add_large(&queue, 4, true);
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

/// Steps of updates that were recorded, in their order.
static UPDATED: Mutex<Vec<u64>> = Mutex::new(Vec::new());

/// An algorithm whose second phase takes 5 ms a step, and the first nothing.
struct InPhases {
    record: bool,
}

impl Algorithm for InPhases {
    fn phases(&self) -> Vec<u64> {
        vec![0, 30]
    }

    fn update(&mut self, step: u64, _: &Batch) -> candle_core::Result<Measured> {
        if self.record {
            UPDATED.lock().unwrap().push(step);
            std::thread::sleep(Duration::from_millis(if step < 30 { 0 } else { 5 }));
        }
        Ok(vec![(if step < 150 { "first" } else { "second" }, step as f32)])
    }

    fn evaluate(&self, _: u64, _: &Batch) -> candle_core::Result<Measured> {
        unreachable!("nothing is held out")
    }

    fn policy(&self) -> candle_core::Result<(PolicyConfig, Tensors)> {
        let actor = MlpConfig::default();
        let shape =
            GaussianShape { observation_dim: 1, action_dim: 1, actor, spread: Spread::None };
        Ok((PolicyConfig::Gaussian { shape }, Tensors::new()))
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        StateDict::default()
    }
}

const fn metric(name: &'static str) -> Metric {
    Metric { name, help: "What a phase measures.", label: "", held_out: false }
}

/// The algorithm in phases, which records its steps if the table says so.
fn in_phases(record: bool) -> Agent {
    let definition = Definition {
        name: "in-phases",
        metrics: const { &[metric("first"), metric("second")] },
        read: |table| {
            let record = table.contains_key("record");
            let new =
                move |_| -> Result<Box<dyn Algorithm>, _> { Ok(Box::new(InPhases { record })) };
            Ok(Start { columns: Columns::Plain, new: Box::new(new) })
        },
        ..Definition::PLAIN
    };
    let keys = record.then(|| ("record".to_owned(), true.into()));
    Agent::new(definition, &toml::Table::from_iter(keys), context(100)).unwrap()
}

#[test]
fn a_row_averages_only_the_steps_that_measured_a_metric() {
    let trained = run(in_phases(false), schedule(300, 0));
    assert_eq!(trained.outcome.unwrap(), Outcome::Completed);
    let mean = |row: &Row, name: &str| serde_json::to_value(row).unwrap()[name].as_f64();
    let means = trained.rows.iter().map(|row| (mean(row, "first"), mean(row, "second")));
    let expected = [(Some(49.5), None), (Some(124.5), Some(174.5)), (None, Some(249.5))];
    assert_eq!(Vec::from_iter(means), expected);
    assert!(!trained.gauges.contains("first") && trained.gauges.contains("second"));
}

/// Some updates come at each second, fifth or twentieth step.
#[test]
fn an_estimate_is_of_whole_cycles_of_steps_within_each_phase_of_each_kind_of_batch() {
    let mut agent = in_phases(true);
    let mut examples = agent.examples(Arc::new(transitions())).unwrap();
    let mut sampler = BatchSampler::new(examples.len(), 4, 0, 0);
    let seconds = mean_step(&mut agent, &mut examples, &mut sampler, [45, 60]).unwrap();
    assert!(seconds >= 0.0025, "half of the steps take 5 ms");
    let updated = UPDATED.lock().unwrap().clone();
    let mut rest = &updated[..];
    for phase in [0..30, 30..45, 45..60] {
        let count = rest.iter().take_while(|step| **step < phase.end).count();
        let (steps, later) = rest.split_at(count);
        assert!(steps.iter().copied().eq(phase.cycle().take(steps.len())), "{steps:?}");
        assert!(steps.len() > 1 && (steps.len() - 1).is_multiple_of(20), "{}", steps.len());
        rest = later;
    }
    assert!(rest.is_empty());
}
