//! Tests: an update against an independent implementation (tests/golden/README.md), and values that
//! are known exactly.

use super::*;
use crate::definition::{Metric, metrics};
use crate::golden::{Golden, check_update, context, golden_tests, items, load, table};
use quad_dataset::{Arrays, Transitions};
use quad_nn::Precision;
use std::sync::Arc;

const METRICS: &[Metric] = &metrics! { q_mean: ""; critic_loss: ""; };

fn numbers(tensor: &Tensor) -> Vec<f32> {
    tensor.to_device(&Device::Cpu).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

fn check(golden: &Golden, device: &Device) {
    let input = |name| numbers(&golden.input(name, device));
    let [offset, scale, least, most] = <[f32; 4]>::try_from(input("units")).unwrap().map(f64::from);
    let units = Units { offset, scale, least, most };
    let mut fqe = Fqe::new(
        read(&table(golden)).unwrap(),
        units,
        context(golden, device),
        input("next_actions"),
    )
    .unwrap();
    load(golden, fqe.parts());
    let values = fqe.values(&input("observations"), &input("actions")).unwrap();
    golden.close("select.values", &Tensor::new(values, &Device::Cpu).unwrap());
    let measured = fqe.update(golden.count("/step") as u64, &items(golden)).unwrap();
    check_update(golden, METRICS, &measured, fqe.parts().save().unwrap());
}

golden_tests!("fqe", check);

const GAMMA: f32 = 0.9;
const BATCH: usize = 64;

/// s' = s/2 + 2a/5, the reward −s², nothing terminates; a row for each of 30 × 30 states and
/// actions in [−1, 1].
fn linear() -> Context {
    let grid = |i: usize| (2 * i) as f32 / 29.0 - 1.0;
    let (states, actions): (Vec<f32>, Vec<f32>) =
        (0..900).map(|row| (grid(row / 30), grid(row % 30))).unzip();
    let transitions = Transitions::of(Arrays {
        observation_dim: 1,
        action_dim: 1,
        rewards: states.iter().map(|s| -s * s).collect(),
        next_observations: states.iter().zip(&actions).map(|(s, a)| 0.5 * s + 0.4 * a).collect(),
        observations: states,
        actions,
        terminals: vec![false; 900],
        timeouts: vec![true; 900],
    });
    Context {
        transitions: Arc::new(transitions.unwrap()),
        batch_size: BATCH,
        total_steps: 0,
        seed: 0,
        precision: Precision::F32,
        device: Device::Cpu,
    }
}

/// The evaluation of the policy a = −s/2.
fn of_linear_policy() -> Fqe {
    let (context, mut batch) = (linear(), quad_dataset::Batch::default());
    context.transitions.gather(&Vec::from_iter(0..900), &mut batch);
    let units = Units::of(&context, GAMMA.into());
    assert!(
        (units.least - -10.0).abs() < 1e-4 && units.most > -0.01 && units.most < 0.0,
        "{units:?}"
    );
    let next_actions = batch.next_observations.iter().map(|s| -0.5 * s).collect();
    let faster = (Positive(1e-3), Rate(0.05));
    let config = FqeConfig {
        learning_rate: faster.0,
        ema_rate: faster.1,
        ..FqeConfig::with_discount(GAMMA).unwrap()
    };
    Fqe::new(config, units, context, next_actions).unwrap()
}

fn train(fqe: &mut Fqe, steps: std::ops::Range<u64>) {
    for step in steps {
        // 277 has no factor in common with 900.
        let items = Vec::from_iter(
            (0..BATCH as u64).map(|i| ((step * BATCH as u64 + i) * 277 % 900) as u32),
        );
        fqe.update(step, &items).unwrap();
    }
}

#[test]
fn a_linear_policy_has_the_value_that_is_known_exactly() {
    let mut fqe = of_linear_policy();
    train(&mut fqe, 0..4000);
    // In its closed loop s' = 0.3 s, so that V(s) = −s²/(1 − 0.09γ).
    let exact =
        |s: f32, a: f32| -s * s - GAMMA * (0.5 * s + 0.4 * a).powi(2) / (1.0 - 0.09 * GAMMA);
    let pairs = [(0.0, 0.0), (0.8, -0.4), (-0.8, 0.4), (0.5, 0.9), (-0.5, -0.9), (0.9, 0.9)];
    let (states, actions): (Vec<f32>, Vec<f32>) = pairs.into_iter().unzip();
    for ((s, a), found) in pairs.into_iter().zip(fqe.values(&states, &actions).unwrap()) {
        assert!(
            (found - exact(s, a)).abs() < 0.08,
            "Q({s}, {a}) is {}, but was found to be {found}",
            exact(s, a)
        );
    }
}

#[test]
fn a_saved_evaluation_goes_on_bit_for_bit() {
    let mut straight = of_linear_policy();
    train(&mut straight, 0..5);
    let mut saved = straight.parts().save().unwrap();
    saved.values_mut().for_each(|tensor| *tensor = tensor.copy().unwrap());
    train(&mut straight, 5..10);
    let mut resumed = of_linear_policy();
    resumed.parts().load(&mut saved).unwrap();
    train(&mut resumed, 5..10);
    let state = |fqe: &mut Fqe| Vec::from_iter(fqe.parts().save().unwrap().values().map(numbers));
    assert!(state(&mut resumed) == state(&mut straight));
}

#[test]
fn the_behavior_s_own_value_is_learned_where_the_data_says_what_it_did() {
    // Two episodes of three steps with a reward of 1 each: one terminates, of the other nothing is
    // known after the cut.
    let transitions = Transitions::of(Arrays {
        observation_dim: 1,
        action_dim: 1,
        observations: vec![0.0, 0.1, 0.2, -0.1, -0.2, -0.3],
        actions: vec![0.1, 0.2, 0.3, -0.1, -0.2, -0.3],
        rewards: vec![1.0; 6],
        next_observations: vec![0.1, 0.2, 0.3, -0.2, -0.3, -0.4],
        terminals: vec![false, false, true, false, false, false],
        timeouts: vec![false, false, false, false, false, true],
    });
    let context = Context { transitions: Arc::new(transitions.unwrap()), ..linear() };
    let units = Units::of(&context, 0.5);
    assert_eq!((units.least, units.most, units.offset), (1.0, 2.0, (1.75 + 1.5 + 1.0) / 3.0));
    let fqe = Fqe::of_behavior(FqeConfig::with_discount(0.5).unwrap(), units, context).unwrap();
    assert_eq!((fqe.items(), &fqe.items[..]), (5, &[0, 1, 2, 3, 4][..]));
    assert_eq!(numbers(&fqe.next_actions)[..2], [0.2, 0.3]);
}
