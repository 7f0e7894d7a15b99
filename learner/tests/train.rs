//! The training loop: what it hands over and when, and how it ends.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::cell::RefCell;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Duration;

use candle_core::Device;
use quad_dataset::{BatchSampler, D4rlWriter, Metadata, ReadOptions, RewardRule, Row, Transitions, environment};
use quad_learner::agent::Agent;
use quad_learner::algorithms::{Setting, named};
use quad_learner::config::{Schedule, resolve};
use quad_learner::metrics::Metrics;
use quad_learner::run_dir::Checkpoint;
use quad_learner::train::{self, Outcome, Outlets, Plan, TrainError, train};
use quad_policy::Precision;
use quad_protocol::Name;
use quad_service::Health;

struct Result {
    outcome: std::result::Result<Outcome, TrainError>,
    /// Step, whether it is to be evaluated.
    snapshots: Vec<(u64, bool)>,
    checkpoints: Vec<Checkpoint>,
    rows: Receiver<train::Row>,
    metrics: Metrics,
}

fn transitions() -> Transitions {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tiny.hdf5");
    let hopper = environment::find("hopper").unwrap();
    let mut writer = D4rlWriter::create(&path, hopper).unwrap();
    for step in 0..100 {
        let observation = |step: usize| Vec::from_iter((0..11).map(|i| ((step + 3 * i) as f64 * 0.1).sin()));
        let row = Row {
            observation: &observation(step),
            action: &[0.1, -0.2, 0.3],
            next_observation: &observation(step + 1),
            reward: if step < 50 { 1.0 } else { 2.0 },
            terminal: false,
            timeout: step % 50 == 49,
            qpos: &[0.0; 6],
            qvel: &[0.0; 6],
        };
        writer.push(&row).unwrap();
    }
    writer.finish(&Metadata { algorithm: "made up", iteration: 0, seed: 0 }).unwrap();
    Transitions::read(&path, &ReadOptions { environment: Some(hopper), reward: RewardRule::Locomotion }).unwrap()
}

/// Hyper-parameters of a preset with small networks.
fn small(preset: &str) -> toml::Table {
    let mut table = resolve(preset, &toml::Table::new()).unwrap().agent;
    table.insert("hidden".to_owned(), 8.into());
    table
}

/// Evaluations at an interval, checkpoints after every step.
fn plan(steps: u64, eval_interval: u64) -> Plan {
    Plan { schedule: Schedule { steps, eval_interval }, checkpoint_every: Duration::ZERO, seconds_before: 0.0 }
}

fn run(plan: Plan, algorithm: &str, table: &toml::Table, stop: bool) -> Result {
    run_from(None, plan, algorithm, table, stop)
}

fn run_from(from: Option<&Checkpoint>, plan: Plan, algorithm: &str, table: &toml::Table, stop: bool) -> Result {
    let transitions = transitions();
    let setting = Setting {
        observation_dim: 11,
        action_dim: 3,
        batch_size: 4,
        total_steps: plan.schedule.steps,
        seed: 0,
        precision: Precision::F32,
        device: Device::Cpu,
    };
    let definition = named(algorithm).unwrap();
    let start = (definition.read)(table).unwrap().start(&setting).unwrap();
    let mut agent = Agent::new(definition, start, Device::Cpu);
    if let Some(checkpoint) = from {
        agent.load(&checkpoint.state).unwrap();
    }
    let mut sampler = BatchSampler::new(transitions.len(), setting.batch_size, 0, agent.step());
    let (metrics, _) = Metrics::new(&Name::new("run").unwrap(), plan.schedule.steps, definition.metrics).unwrap();
    // Nobody takes the rows, as with a disk that hangs: training must end all the same.
    let (sender, rows) = sync_channel(2);
    let (snapshots, checkpoints) = (RefCell::new(Vec::new()), RefCell::new(Vec::new()));
    let outlets = Outlets {
        metrics: metrics.training.clone(),
        rows: sender,
        snapshot: &|snapshot| snapshots.borrow_mut().push((snapshot.step, snapshot.evaluate)),
        checkpoint: &|checkpoint| checkpoints.borrow_mut().push(checkpoint),
        stop: &AtomicBool::new(stop),
        beat: &Health::default().part("training", Duration::from_secs(60)),
    };
    let outcome = train(&mut agent, &transitions, &mut sampler, plan, &outlets);
    drop(outlets);
    Result { outcome, snapshots: snapshots.into_inner(), checkpoints: checkpoints.into_inner(), rows, metrics }
}

#[test]
fn snapshots_come_at_every_interval_and_at_the_end() {
    let result = run(plan(25, 10), "quad", &small("hopper-demo"), false);
    assert_eq!(result.outcome.unwrap(), Outcome::Completed);
    assert_eq!(result.snapshots, [(10, true), (20, true), (25, true)]);
    assert_eq!(result.metrics.training.gradient_steps.get(), 25);
    assert_eq!(result.metrics.training.step_duration.get_sample_count(), 25);
}

#[test]
fn without_evaluations_the_last_snapshot_is_kept_all_the_same() {
    let result = run(plan(25, 0), "quad", &small("hopper-demo"), false);
    assert_eq!(result.snapshots, [(25, false)]);
}

#[test]
fn rows_average_a_hundred_steps_and_those_that_nobody_takes_are_dropped() {
    let result = run(plan(450, 0), "quad", &small("hopper-demo"), false);
    assert_eq!(result.outcome.unwrap(), Outcome::Completed);
    let rows: Vec<_> = result.rows.try_iter().collect();
    assert_eq!(rows.iter().map(|row| row.step).collect::<Vec<_>>(), [100, 200]);
    for row in rows {
        let json = serde_json::to_value(&row).unwrap();
        let value = |name: &str| json[name].as_f64().unwrap();
        assert!(value("eta") == 1.0 && (0.0..=1.0).contains(&value("lambda_mean")) && value("bc_loss") > 0.0, "{json}");
        assert_eq!(json.as_object().unwrap().len(), 2 + row.metrics.len(), "{json}");
    }
}

#[test]
fn a_stop_ends_after_the_step_with_a_checkpoint() {
    let result = run(plan(25, 10), "quad", &small("hopper-demo"), true);
    assert_eq!(result.outcome.unwrap(), Outcome::Stopped { step: 1 });
    assert_eq!(result.snapshots, []);
    assert_eq!(result.checkpoints.len(), 1);
}

#[test]
fn training_goes_on_from_any_checkpoint_bit_for_bit() {
    for (algorithm, preset) in [("quad", "hopper-demo"), ("iql", "hopper-demo-iql")] {
        // Saving may take a hundredth of the time, so it is the clock that says how many there are.
        let whole = run(plan(300, 100), algorithm, &small(preset), false);
        let steps: Vec<_> = whole.checkpoints.iter().map(|checkpoint| checkpoint.step).collect();
        assert!(steps.len() > 1 && steps.ends_with(&[300]), "{steps:?}");
        for from in whole.checkpoints.iter().rev().take(5) {
            let rest = run_from(Some(from), plan(300, 100), algorithm, &small(preset), false);
            let snapshots = whole.snapshots.iter().copied().filter(|(step, _)| *step > from.step);
            assert_eq!(rest.snapshots, Vec::from_iter(snapshots), "after step {}", from.step);
            if from.step < 300 {
                assert!(rest.checkpoints.last() == whole.checkpoints.last(), "after step {}", from.step);
            }
        }
    }
}

#[test]
fn divergence_is_an_error_that_says_where_and_what() {
    for (algorithm, preset) in [("quad", "hopper-demo"), ("iql", "hopper-demo-iql")] {
        let mut table = small(preset);
        table.insert("critic_learning_rate".to_owned(), 1e30.into());
        let result = run(plan(25, 10), algorithm, &table, false);
        let error = result.outcome.unwrap_err();
        assert!(matches!(error, TrainError::Diverged { step: 1..10, .. }), "{error}");
        assert!(result.snapshots.is_empty(), "nothing broken is handed to evaluation");
    }
}
