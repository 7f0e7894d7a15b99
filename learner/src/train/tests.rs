//! Tests of the training loop: its output and its end.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use candle_core::Device;
use prometheus::proto::MetricFamily;
use quad_algorithms::{
    Agent, Algorithm, Context, Definition, Measured, Metric, Reporting, StateDict,
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
use super::held_out::HeldOut;
use super::output_queue::{Output, OutputQueue};
use super::results::{Outcome, Row, TrainedPolicy};
use super::training::{TrainError, Training};

#[path = "../../../tests/fixtures/hopper.rs"]
mod hopper;
use hopper::write_hopper;

mod cost;
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

/// Hyper-parameters of the demonstration with small networks.
fn small(algorithm: &str) -> toml::Table {
    let asked = toml::Table::from_iter([("algorithm".to_owned(), algorithm.into())]);
    let mut table = resolve("hopper-demo", &asked).unwrap().agent.to_table();
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
        batch_size: 4,
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
    let definition = definition(algorithm).unwrap();
    Agent::new(definition, &small(algorithm).into(), context(total_steps)).unwrap()
}

fn run_quad(schedule: Schedule) -> Trained {
    run(agent("quad", schedule.steps), None, schedule, false)
}

/// Trains with a checkpoint after every step.
fn run(agent: Agent, held_out: Option<HeldOut>, schedule: Schedule, stop: bool) -> Trained {
    let registry = prometheus::Registry::new();
    let metrics = TrainingMetrics::new(&registry, schedule.steps, agent.metrics()).unwrap();
    let mut training = Training {
        sampler: BatchSampler::new(agent.dataset_len(), 4, 0, agent.step()),
        agent,
        online: None,
        held_out,
        schedule,
        origin: origin(&resolve("hopper-demo", &toml::Table::new()).unwrap()),
        checkpoint_every: Duration::ZERO,
        seconds_before: 0.0,
        metrics: metrics.clone(),
        queue: OutputQueue::default(),
        stop: Arc::new(stop.into()),
    };
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
    let trained = run_quad(schedule(25, 10));
    assert_eq!(trained.outcome.unwrap(), Outcome::Completed);
    assert_eq!(trained.snapshots, [(10, true), (20, true), (25, true)]);
    assert_eq!(trained.metrics.gradient_steps.get(), 25);
    assert_eq!(trained.metrics.step_duration.get_sample_count(), 25);
    assert_eq!(run_quad(schedule(25, 0)).snapshots, [(25, false)], "without evaluations");
}

#[test]
fn rows_average_a_hundred_steps() {
    let trained = run_quad(schedule(450, 0));
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
    let trained = run(agent("quad", 25), None, schedule(25, 10), true);
    assert_eq!(trained.outcome.unwrap(), Outcome::Stopped);
    assert_eq!(trained.snapshots, []);
    assert_eq!(trained.checkpoint.unwrap().step, 1);
}

#[test]
fn training_resumes_from_a_checkpoint_bit_for_bit() {
    for algorithm in ["quad", "iql"] {
        let whole = run(agent(algorithm, 300), None, schedule(300, 100), false);
        for stop_at in [1, 99, 100, 250] {
            let first = run(agent(algorithm, 300), None, schedule(stop_at, 100), false);
            let mut resumed = agent(algorithm, 300);
            resumed.load(&first.checkpoint.unwrap().state).unwrap();
            let rest = run(resumed, None, schedule(300, 100), false);
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
        queue.row(Row { step, seconds: 0.0, metrics: &[], values, held_out, online: Vec::new() });
        queue.checkpoint(checkpoint(step));
    }
    queue.ended(Outcome::Completed);
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
        let agent = Agent::new(definition(algorithm).unwrap(), &table.into(), context(25)).unwrap();
        let trained = run(agent, None, schedule(25, 10), false);
        let error = trained.outcome.unwrap_err();
        assert!(matches!(error, TrainError::Diverged { step: 1..10, .. }), "{error}");
        assert!(trained.snapshots.is_empty(), "no broken policy is evaluated");
    }
}

/// Losses and weights stay finite where a gradient is too large to be squared.
#[test]
fn a_state_that_cannot_be_saved_leaves_no_snapshot_of_its_step() {
    let (n, context) = (30, context(25));
    let (o, a) = (context.transitions.observation_dim(), context.transitions.action_dim());
    let mut observations = vec![0.5; n * o];
    observations[0] = 1e12;
    let arrays = Arrays {
        observation_dim: o,
        action_dim: a,
        next_observations: vec![0.5; n * o],
        observations,
        actions: vec![0.5; n * a],
        rewards: vec![1.0; n],
        terminals: vec![false; n],
        timeouts: (1..=n).map(|row| row == n).collect(),
    };
    let transitions = Arc::new(Transitions::of(arrays).unwrap());
    let context = Context { transitions, ..context };
    let agent = Agent::new(definition("td3-bc").unwrap(), &small("td3-bc").into(), context);
    let trained = run(agent.unwrap(), None, schedule(25, 1), false);
    let error = trained.outcome.unwrap_err();
    let TrainError::Diverged { step, what } = error else { panic!("{error}") };
    assert!(what.contains("adam"), "{what}");
    let before = (1..step).map(|step| (step, true));
    assert_eq!(trained.snapshots, Vec::from_iter(before));
}

/// An algorithm whose second phase, of half the run, takes 20 ms a step, and the others nothing.
struct InPhases;

impl Algorithm for InPhases {
    fn phases(&self) -> Vec<u64> {
        vec![0, 25, 75]
    }

    fn update(&mut self, step: u64, _: &[u32]) -> candle_core::Result<Measured> {
        if (25..75).contains(&step) {
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(vec![(if step < 150 { "first" } else { "second" }, step as f32)])
    }

    fn evaluate(&self, _: u64, _: &[u32]) -> candle_core::Result<Measured> {
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

const IN_PHASES: Definition = Definition {
    name: "in-phases",
    presets: "",
    metrics: const { &[metric("first"), metric("second")] },
    report: Reporting::PLAIN,
    chunks: false,
    read: |_| Ok(Arc::new(|_| Ok(Box::new(InPhases)))),
};

fn in_phases() -> Agent {
    made_up(IN_PHASES)
}

fn made_up(definition: Definition) -> Agent {
    Agent::new(definition, &toml::Table::new().into(), context(100)).unwrap()
}

#[test]
fn a_row_averages_only_the_steps_that_measured_a_metric() {
    let trained = run(in_phases(), None, schedule(300, 0), false);
    assert_eq!(trained.outcome.unwrap(), Outcome::Completed);
    let mean = |row: &Row, name: &str| serde_json::to_value(row).unwrap()[name].as_f64();
    let means = trained.rows.iter().map(|row| (mean(row, "first"), mean(row, "second")));
    let expected = [(Some(49.5), None), (Some(124.5), Some(174.5)), (None, Some(249.5))];
    assert_eq!(Vec::from_iter(means), expected);
    assert!(!trained.gauges.contains("first") && trained.gauges.contains("second"));
}
