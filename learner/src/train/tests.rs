//! The training loop: what it hands over and when, and how it ends.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use candle_core::Device;
use quad_algorithms::{Agent, Algorithm, Context, Definition, Measured, Parts, Reporting};
use quad_dataset::{BatchSampler, ReadOptions, RewardRule, Scale, Transitions, environment};
use quad_policy::{PolicyConfig, Precision, Tensors};
use quad_protocol::Origin;
use quad_run::config::hyperparameters::algorithm as definition;
use quad_run::config::{Schedule, resolve};
use quad_run::run::Checkpoint;
use quad_runtime::{Beat, Health};

use super::held_out::HeldOut;
use super::outbox::{Outbox, Work};
use super::price::mean_step;
use super::results::{self, Outcome};
use super::steps::{Outlets, Plan, TrainError, train};
use super::{Registrar, TrainingMetrics};

#[path = "../../../tests/fixtures/hopper.rs"]
mod hopper;
use hopper::write_hopper;

/// What a run has handed over.
struct Result {
    outcome: std::result::Result<Outcome, TrainError>,
    /// Step, whether it is to be evaluated.
    snapshots: Vec<(u64, bool)>,
    checkpoint: Option<Checkpoint>,
    rows: Vec<results::Row>,
    metrics: TrainingMetrics,
}

fn beat() -> Beat {
    Health::default().part("training", Duration::from_secs(60))
}

fn transitions() -> Transitions {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tiny.hdf5");
    let hopper = environment::find("hopper").unwrap();
    write_hopper(&path, 2, 50);
    Transitions::read(
        &path,
        &ReadOptions { environment: Some(hopper), task: None, reward: RewardRule::Locomotion, scale: Scale::default() },
    )
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

/// A run of so many steps.
fn context(total_steps: u64) -> Context {
    Context {
        transitions: Arc::new(transitions()),
        batch_size: 4,
        total_steps,
        seed: 0,
        precision: Precision::F32,
        device: Device::Cpu,
    }
}

/// Evaluations at an interval, checkpoints after every step.
fn plan(steps: u64, eval_interval: u64) -> Plan {
    Plan { schedule: Schedule { steps, eval_interval }, checkpoint_every: Duration::ZERO, seconds_before: 0.0 }
}

fn run(plan: Plan, algorithm: &str, table: &toml::Table, stop: bool) -> Result {
    run_of(plan.schedule.steps, None, plan, algorithm, table, stop)
}

/// A part of a run of so many steps in all.
fn run_of(
    total_steps: u64,
    from: Option<&Checkpoint>,
    plan: Plan,
    algorithm: &str,
    table: &toml::Table,
    stop: bool,
) -> Result {
    let definition = definition(algorithm).unwrap();
    let mut agent = Agent::new(definition, table, context(total_steps)).unwrap();
    if let Some(checkpoint) = from {
        agent.load(&checkpoint.state).unwrap();
    }
    let mut sampler = BatchSampler::new(agent.items(), 4, 0, agent.step());
    let make = Registrar { registry: prometheus::Registry::new() };
    let metrics = TrainingMetrics::new(&make, plan.schedule.steps, definition.metrics, false).unwrap();
    let outbox = Outbox::default();
    let origin = Origin { environment: "hopper".to_owned(), seed: 0, step: 0, episodes: 10 };
    let (stop, beat) = (&AtomicBool::new(stop), &beat());
    let outlets = Outlets { metrics: &metrics, outbox: &outbox, origin: &origin, stop, beat };
    // Nothing takes what it hands over, as with a disk that hangs: training must end all the same.
    let outcome = train(&mut agent, &mut sampler, None, plan, &outlets);
    let mut result = Result { outcome, snapshots: Vec::new(), checkpoint: None, rows: Vec::new(), metrics };
    outbox.close();
    while let Some(work) = outbox.next(beat) {
        match work {
            Work::Snapshot(policy) => result.snapshots.push((policy.step, policy.evaluate)),
            Work::Checkpoint(checkpoint) => result.checkpoint = Some(checkpoint),
            Work::Rows(rows) => result.rows.extend(rows),
            Work::Ended(_) => panic!("the loop does not say so"),
        }
    }
    result
}

#[test]
fn snapshots_come_at_every_interval_and_at_the_end() {
    let result = run(plan(25, 10), "quad", &small("quad"), false);
    assert_eq!(result.outcome.unwrap(), Outcome::Completed);
    assert_eq!(result.snapshots, [(10, true), (20, true), (25, true)]);
    assert_eq!(result.metrics.gradient_steps.get(), 25);
    assert_eq!(result.metrics.step_duration.get_sample_count(), 25);
}

#[test]
fn without_evaluations_the_last_snapshot_is_kept_all_the_same() {
    let result = run(plan(25, 0), "quad", &small("quad"), false);
    assert_eq!(result.snapshots, [(25, false)]);
}

#[test]
fn rows_average_a_hundred_steps() {
    let result = run(plan(450, 0), "quad", &small("quad"), false);
    assert_eq!(result.outcome.unwrap(), Outcome::Completed);
    assert_eq!(result.rows.iter().map(|row| row.step).collect::<Vec<_>>(), [100, 200, 300, 400, 450]);
    for row in result.rows {
        let json = serde_json::to_value(&row).unwrap();
        let value = |name: &str| json[name].as_f64().unwrap();
        assert!(value("eta") == 1.0 && (0.0..=1.0).contains(&value("lambda_mean")) && value("bc_loss") > 0.0, "{json}");
        assert_eq!(json.as_object().unwrap().len(), 2 + row.metrics.len(), "{json}");
    }
}

#[test]
fn a_stop_ends_after_the_step_with_a_checkpoint() {
    let result = run(plan(25, 10), "quad", &small("quad"), true);
    assert_eq!(result.outcome.unwrap(), Outcome::Stopped { step: 1 });
    assert_eq!(result.snapshots, []);
    assert_eq!(result.checkpoint.unwrap().step, 1);
}

#[test]
fn training_goes_on_from_a_checkpoint_bit_for_bit() {
    for algorithm in ["quad", "iql"] {
        let setting = small(algorithm);
        let whole = run(plan(300, 100), algorithm, &setting, false);
        for stop_at in [1, 99, 100, 250] {
            // Learning rates that decay know the end of the whole run.
            let Plan { schedule, .. } = plan(300, 100);
            let until = Plan { schedule: Schedule { steps: stop_at, ..schedule }, ..plan(300, 100) };
            let begun = run_of(300, None, until, algorithm, &setting, false);
            let rest = run_of(300, begun.checkpoint.as_ref(), plan(300, 100), algorithm, &setting, false);
            assert!(rest.checkpoint == whole.checkpoint, "after step {stop_at}");
            let snapshots: Vec<_> = whole.snapshots.iter().copied().filter(|(step, _)| *step > stop_at).collect();
            assert_eq!(rest.snapshots, snapshots, "after step {stop_at}");
        }
    }
}

/// The disk hangs: of checkpoints the newest waits, of snapshots all, and of rows so many that none is missed for hours.
#[test]
fn what_the_disk_does_not_take_comes_later_in_its_order() {
    let outbox = Outbox::default();
    let checkpoint = |step: u64| Checkpoint { step, state: vec![step as u8] };
    let row = |step| results::Row { step, seconds: 0.0, metrics: &[], values: vec![], held_out: vec![] };
    (1..=3).for_each(|step| outbox.checkpoint(checkpoint(step)));
    (1..=3).for_each(|step| outbox.row(row(step)));
    let Some(refused) = outbox.next(&beat()) else { panic!("something waits") };
    outbox.put_back(refused);
    outbox.ended(Outcome::Completed);
    assert!(matches!(outbox.next(&beat()), Some(Work::Checkpoint(newest)) if newest == checkpoint(3)));
    let Some(Work::Rows(rows)) = outbox.next(&beat()) else { panic!("rows wait") };
    outbox.row(row(4));
    outbox.put_back(Work::Rows(rows));
    let Some(Work::Rows(rows)) = outbox.next(&beat()) else { panic!("rows wait") };
    assert_eq!(rows.iter().map(|row| row.step).collect::<Vec<_>>(), [1, 2, 3, 4]);
    assert!(matches!(outbox.next(&beat()), Some(Work::Ended(Outcome::Completed))), "the end comes last");
    outbox.close();
    assert!(outbox.next(&beat()).is_none());
}

#[test]
fn divergence_is_an_error_that_says_where_and_what() {
    for algorithm in ["quad", "iql"] {
        let mut table = small(algorithm);
        table.insert("critic_learning_rate".to_owned(), 1e30.into());
        let result = run(plan(25, 10), algorithm, &table, false);
        let error = result.outcome.unwrap_err();
        assert!(matches!(error, TrainError::Diverged { step: 1..10, .. }), "{error}");
        assert!(result.snapshots.is_empty(), "nothing broken is handed to evaluation");
    }
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
        Ok(Measured::new())
    }

    fn policy(&self) -> candle_core::Result<(PolicyConfig, Tensors)> {
        unreachable!("nothing asks for it")
    }

    fn parts(&mut self) -> Parts<'_> {
        Parts::default()
    }
}

#[test]
fn the_estimate_of_a_step_is_the_mean_over_all_phases() {
    let definition = Definition {
        name: "in-phases",
        settings: "",
        metrics: &[],
        report: Reporting::PLAIN,
        check: |_| Ok(()),
        start: |_, _| Ok(Box::new(InPhases)),
    };
    let mut agent = Agent::new(definition, &toml::Table::new(), context(100)).unwrap();
    let mut sampler = BatchSampler::new(agent.items(), 4, 0, 0);
    assert!(mean_step(&mut agent, &mut sampler, 100).unwrap() >= 0.01, "the second phase is not in it");
}

#[test]
fn measuring_on_held_out_episodes_changes_nothing() {
    let agent = || Agent::new(definition("quad").unwrap(), &small("quad"), context(20)).unwrap();
    let ([mut alone, mut measured], mut held_out) = ([agent(), agent()], HeldOut::of(agent(), 4, 0, 20));
    for step in 1..=5 {
        let items = [0, 1, 2, 3];
        assert_eq!(alone.update(&items).unwrap(), measured.update(&items).unwrap());
        let values = held_out.values(step, || measured.save()).unwrap().to_vec();
        assert!(values.iter().all(|value| value.is_finite() && *value != 0.0), "{values:?}");
        assert_eq!(values, held_out.values(step, || panic!("it is not time again")).unwrap());
    }
    assert_eq!(alone.save().unwrap(), measured.save().unwrap());
}
