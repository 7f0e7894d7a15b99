//! Tests of `fqe.rs`.

use super::*;
use crate::definition::{Metric, metrics};
use crate::golden::{check_update, context, devices, goldens, load, table};
use quad_dataset::{Arrays, Transitions};
use std::sync::Arc;

const METRICS: &[Metric] = &metrics! { target_q_mean: ""; critic_loss: ""; };

fn numbers(tensor: &Tensor) -> Vec<f32> {
    tensor.to_device(&Device::Cpu).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

#[test]
fn golden_update() {
    for (golden, device) in
        goldens("fqe").iter().flat_map(|golden| devices().into_iter().map(move |on| (golden, on)))
    {
        let input = |name| numbers(&golden.input(name, &device));
        let [offset, scale, least, most] =
            <[f32; 4]>::try_from(input("units")).unwrap().map(f64::from);
        let units = Units { offset, scale, least, most };
        let config = read(&table(golden)).unwrap();
        let mut fqe = Fqe::of_behavior(config, units, context(golden, &device)).unwrap();
        load(golden, fqe.state_dict());
        let values = fqe.values(&input("observations"), &input("actions")).unwrap();
        golden.close("select.values", &Tensor::new(values, &Device::Cpu).unwrap());
        let indices = Vec::from_iter(0..golden.count("/batch_size") as u32);
        let measured = fqe.update(golden.count("/step") as u64, &indices).unwrap();
        check_update(golden, METRICS, &measured, fqe.state_dict().save().unwrap());
    }
}

#[test]
fn the_behavior_is_evaluated_on_transitions_with_a_next_action() {
    // Two episodes of three steps with a reward of 1 each: one terminates, of the other nothing is
    // known after the cut.
    let transitions = |reward: f32| {
        Transitions::of(Arrays {
            observation_dim: 1,
            action_dim: 1,
            observations: vec![0.0, 0.1, 0.2, -0.1, -0.2, -0.3],
            actions: vec![0.1, 0.2, 0.3, -0.1, -0.2, -0.3],
            rewards: vec![reward; 6],
            next_observations: vec![0.1, 0.2, 0.3, -0.2, -0.3, -0.4],
            terminals: vec![false, false, true, false, false, false],
            timeouts: vec![false, false, false, false, false, true],
        })
    };
    let context = |reward| Context {
        transitions: Arc::new(transitions(reward).unwrap()),
        golden: None,
        ..context(&goldens("fqe")[0], &Device::Cpu)
    };
    let costs = Units::of(&context(-1.0), 0.5);
    assert_eq!((costs.least, costs.most), (-2.0, -1.0));
    let context = context(1.0);
    let units = Units::of(&context, 0.5);
    assert_eq!((units.least, units.most, units.offset), (1.0, 2.0, (1.75 + 1.5 + 1.0) / 3.0));
    let fqe = Fqe::of_behavior(FqeConfig::with_discount(0.5).unwrap(), units, context).unwrap();
    assert_eq!((fqe.dataset_len(), &fqe.rows[..]), (5, &[0, 1, 2, 3, 4][..]));
    assert_eq!(numbers(&fqe.next_actions)[..2], [0.2, 0.3]);
}
