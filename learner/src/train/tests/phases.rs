//! Tests of an algorithm that learns in phases.

use std::sync::Mutex;

use quad_algorithms::{Algorithm, Batch, Columns, Definition, Measured, Metric, Start, StateDict};
use quad_nn::Tensors;
use quad_policy::{GaussianShape, MlpConfig, PolicyConfig, Spread};

use super::*;
use crate::train::cost::mean_step;

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
fn a_row_averages_those_of_a_hundred_steps_that_measured_a_metric() {
    let trained = run(in_phases(false), schedule(350, 0));
    assert_eq!(trained.outcome.unwrap(), Outcome::Completed);
    let rows = trained.rows.iter().map(|row| serde_json::to_value(row).unwrap());
    let rows = rows
        .map(|row| (row["step"].as_u64().unwrap(), row["first"].as_f64(), row["second"].as_f64()));
    let expected = [
        (100, Some(49.5), None),
        (200, Some(124.5), Some(174.5)),
        (300, None, Some(249.5)),
        (350, None, Some(324.5)),
    ];
    assert_eq!(Vec::from_iter(rows), expected);
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
