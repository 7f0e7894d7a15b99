//! The training loop: what it hands over and when, and how it ends.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use candle_core::Device;
use quad_algorithms::{
    Agent, Algorithm, Context, Definition, Measured, Metric, Reporting, StateDict,
};
use quad_dataset::{
    Arrays, BatchSampler, Normalize, ReadOptions, RewardRule, Transitions, environment,
};
use quad_nn::Tensors;
use quad_policy::{GaussianShape, MlpConfig, PolicyConfig, Precision};
use quad_protocol::Origin;
use quad_run::config::hyperparameters::algorithm as definition;
use quad_run::config::{Schedule, resolve};
use quad_run::folder::Checkpoint;
use quad_runtime::{Health, Heartbeat};
use serde_json::Value;

use super::held_out::HeldOut;
use super::outbox::{Outbox, Work};
use super::price::mean_step;
use super::results::{self, Outcome};
use super::steps::{Outlets, Plan, TrainError, train};
use super::{Registrar, TrainingMetrics};

#[path = "../../../tests/fixtures/hopper.rs"]
mod hopper;
use hopper::write_hopper;

mod held_out;

/// What a run has handed over.
struct Result {
    outcome: std::result::Result<Outcome, TrainError>,
    /// Step, whether it is to be evaluated.
    snapshots: Vec<(u64, bool)>,
    checkpoint: Option<Checkpoint>,
    rows: Vec<results::Row>,
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
    Transitions::read(
        &path,
        &ReadOptions {
            environment: Some(hopper),
            task: None,
            reward: RewardRule::Locomotion,
            normalize: Normalize::default(),
        },
    )
    .unwrap()
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
    Plan {
        schedule: Schedule { steps, eval_interval },
        checkpoint_every: Duration::ZERO,
        seconds_before: 0.0,
    }
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
    let mut agent =
        Agent::new(definition(algorithm).unwrap(), &table.clone().into(), context(total_steps))
            .unwrap();
    if let Some(checkpoint) = from {
        agent.load(&checkpoint.state).unwrap();
    }
    run_agent(agent, None, plan, stop)
}

/// A run of this agent to the plan's end.
fn run_agent(mut agent: Agent, mut held_out: Option<HeldOut>, plan: Plan, stop: bool) -> Result {
    let mut sampler = BatchSampler::new(agent.dataset_len(), 4, 0, agent.step());
    let make = Registrar { registry: prometheus::Registry::new() };
    let metrics = TrainingMetrics::new(&make, plan.schedule.steps, agent.metrics()).unwrap();
    let outbox = Outbox::default();
    let origin = Origin { environment: "hopper".to_owned(), seed: 0, step: 0, episodes: 10 };
    let (stop, beat) = (&AtomicBool::new(stop), &beat());
    let outlets = Outlets { metrics: &metrics, outbox: &outbox, origin: &origin, stop, beat };
    // Nothing takes what it hands over, as with a disk that hangs: training must end all the same.
    let outcome = train(&mut agent, &mut sampler, held_out.as_mut(), plan, &outlets);
    let families = make.registry.gather();
    let gauges = families
        .iter()
        .map(|family| family.name().trim_start_matches("quad_learner_").to_owned())
        .collect();
    let mut result = Result {
        outcome,
        snapshots: Vec::new(),
        checkpoint: None,
        rows: Vec::new(),
        metrics,
        gauges,
    };
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
    assert_eq!(
        result.rows.iter().map(|row| row.step).collect::<Vec<_>>(),
        [100, 200, 300, 400, 450]
    );
    for row in result.rows {
        let json = serde_json::to_value(&row).unwrap();
        let value = |name: &str| json[name].as_f64().unwrap();
        assert!(
            value("eta") == 1.0
                && (0.0..=1.0).contains(&value("lambda_mean"))
                && value("bc_loss") > 0.0,
            "{json}"
        );
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
            let until =
                Plan { schedule: Schedule { steps: stop_at, ..schedule }, ..plan(300, 100) };
            let begun = run_of(300, None, until, algorithm, &setting, false);
            let rest =
                run_of(300, begun.checkpoint.as_ref(), plan(300, 100), algorithm, &setting, false);
            assert!(rest.checkpoint == whole.checkpoint, "after step {stop_at}");
            let snapshots: Vec<_> =
                whole.snapshots.iter().copied().filter(|(step, _)| *step > stop_at).collect();
            assert_eq!(rest.snapshots, snapshots, "after step {stop_at}");
        }
    }
}

/// The disk hangs: of checkpoints the newest waits, of snapshots all, and of rows so many that none
/// is missed for hours.
#[test]
fn what_the_disk_does_not_take_comes_later_in_its_order() {
    let outbox = Outbox::default();
    let checkpoint = |step: u64| Checkpoint { step, state: vec![step as u8] };
    let row =
        |step| results::Row { step, seconds: 0.0, metrics: &[], values: vec![], held_out: vec![] };
    (1..=3).for_each(|step| outbox.checkpoint(checkpoint(step)));
    (1..=3).for_each(|step| outbox.row(row(step)));
    let Some(refused) = outbox.next(&beat()) else { panic!("something waits") };
    outbox.put_back(refused);
    outbox.ended(Outcome::Completed);
    assert!(
        matches!(outbox.next(&beat()), Some(Work::Checkpoint(newest)) if newest == checkpoint(3))
    );
    let Some(Work::Rows(rows)) = outbox.next(&beat()) else { panic!("rows wait") };
    outbox.row(row(4));
    outbox.put_back(Work::Rows(rows));
    let Some(Work::Rows(rows)) = outbox.next(&beat()) else { panic!("rows wait") };
    assert_eq!(rows.iter().map(|row| row.step).collect::<Vec<_>>(), [1, 2, 3, 4]);
    assert!(
        matches!(outbox.next(&beat()), Some(Work::Ended(Outcome::Completed))),
        "the end comes last"
    );
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
        Ok(vec![(if step < 150 { "first" } else { "second" }, step as f32)])
    }

    fn evaluate(&self, _: u64, _: &[u32]) -> candle_core::Result<Measured> {
        unreachable!("nothing is held out")
    }

    fn policy(&self) -> candle_core::Result<(PolicyConfig, Tensors)> {
        Ok((
            PolicyConfig::Gaussian {
                shape: GaussianShape {
                    observation_dim: 1,
                    action_dim: 1,
                    actor: MlpConfig::default(),
                },
            },
            Tensors::new(),
        ))
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        StateDict::default()
    }
}

const fn metric(name: &'static str) -> Metric {
    Metric { name, help: "What a phase measures.", label: "", held_out: false }
}

fn in_phases() -> Agent {
    let definition = Definition {
        name: "in-phases",
        presets: "",
        metrics: const { &[metric("first"), metric("second")] },
        report: Reporting::PLAIN,
        read: |_| Ok(Arc::new(|_| Ok(Box::new(InPhases)))),
    };
    Agent::new(definition, &toml::Table::new().into(), context(100)).unwrap()
}

#[test]
fn a_row_has_what_its_steps_measured_and_means_of_these_alone() {
    let result = run_agent(in_phases(), None, plan(300, 0), false);
    assert_eq!(result.outcome.unwrap(), Outcome::Completed);
    let rows = Vec::from_iter(result.rows.iter().map(|row| serde_json::to_value(row).unwrap()));
    let means = |row: &Value| {
        ["first", "second"].map(|name| row.get(name).map(|mean| mean.as_f64().unwrap()))
    };
    assert_eq!(
        rows.iter().map(means).collect::<Vec<_>>(),
        [[Some(49.5), None], [Some(124.5), Some(174.5)], [None, Some(249.5)],]
    );
    assert!(
        !result.gauges.contains("first") && result.gauges.contains("second"),
        "{:?}",
        result.gauges
    );
}

#[test]
fn the_estimate_of_a_step_is_the_mean_over_all_phases() {
    let mut agent = in_phases();
    let mut sampler = BatchSampler::new(agent.dataset_len(), 4, 0, 0);
    assert!(
        mean_step(&mut agent, &mut sampler, 100).unwrap() >= 0.01,
        "the second phase is not in it"
    );
}
