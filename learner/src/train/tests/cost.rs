//! Tests of the estimate of a run's cost.

use std::sync::Mutex;

use super::*;
use crate::train::cost::mean_step;

#[test]
fn the_estimate_of_a_step_is_the_mean_over_all_phases() {
    let mut agent = in_phases();
    let mut sampler = BatchSampler::new(agent.dataset_len(), 4, 0, 0);
    assert!(
        mean_step(&mut agent, &mut sampler, 100).unwrap() >= 0.01,
        "the second phase is not in it"
    );
}

/// Steps that were updated, in their order.
static UPDATED: Mutex<Vec<u64>> = Mutex::new(Vec::new());

/// Two phases of 30 steps.
struct Recorded;

impl Algorithm for Recorded {
    fn phases(&self) -> Vec<u64> {
        vec![0, 30]
    }

    fn update(&mut self, step: u64, _: &[u32]) -> candle_core::Result<Measured> {
        UPDATED.lock().unwrap().push(step);
        std::thread::sleep(Duration::from_millis(5));
        Ok(Measured::new())
    }

    fn evaluate(&self, _: u64, _: &[u32]) -> candle_core::Result<Measured> {
        unreachable!("nothing is held out")
    }

    fn policy(&self) -> candle_core::Result<(PolicyConfig, Tensors)> {
        InPhases.policy()
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        StateDict::default()
    }
}

/// Some updates come at each second, fifth or twentieth step.
#[test]
fn an_estimate_is_of_whole_cycles_of_steps_within_each_phase() {
    let definition = Definition { read: |_| Ok(Arc::new(|_| Ok(Box::new(Recorded)))), ..IN_PHASES };
    let mut agent = made_up(definition);
    let mut sampler = BatchSampler::new(agent.dataset_len(), 4, 0, 0);
    mean_step(&mut agent, &mut sampler, 60).unwrap();
    let updated = UPDATED.lock().unwrap().clone();
    let begins = |step: &&u64| **step < 30;
    let first = updated.iter().filter(begins).count();
    let mut expected = Vec::from_iter((0..30).cycle().take(first));
    expected.extend((30..60).cycle().take(updated.len() - first));
    assert_eq!(updated, expected);
    for timed in [first - 1, updated.len() - first - 1] {
        assert!(timed > 0 && timed.is_multiple_of(20), "{timed}");
    }
}
