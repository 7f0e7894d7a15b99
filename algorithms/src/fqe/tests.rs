//! Tests of `fqe.rs`.

use super::*;
use crate::definition::{Metric, metrics};
use crate::golden::{batch, check_update, context, devices, goldens, load, table};
use crate::replay::Inputs;
use quad_dataset::{Arrays, Window};

const METRICS: &[Metric] = &metrics! { target_q_mean: ""; critic_loss: ""; };

fn numbers(tensor: &Tensor) -> Vec<f32> {
    let tensor = tensor.to_device(&Device::Cpu).unwrap();
    tensor.flatten_all().unwrap().to_vec1().unwrap()
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
        let mut fqe = Fqe::new(config, units, context(golden, &device)).unwrap();
        load(golden, fqe.state_dict());
        let values = fqe.values(&input("observations"), &input("actions")).unwrap();
        golden.close("select.values", &Tensor::new(values, &Device::Cpu).unwrap());
        let batch = batch(golden, Window::ONE).on(&device).unwrap();
        let measured = fqe.update(golden.count("/step") as u64, &batch).unwrap();
        check_update(golden, METRICS, &measured, fqe.state_dict().save().unwrap());
    }
}

/// An episode of three steps that terminates, with a reward of 1 or −1 each, and one that is cut
/// off.
#[test]
fn units_are_those_of_the_returns() {
    for (reward, offset, least, most) in
        [(1.0, (1.75 + 1.5 + 1.0) / 3.0, 1.0, 2.0), (-1.0, -(1.75 + 1.5 + 1.0) / 3.0, -2.0, -1.0)]
    {
        let transitions = Transitions::of(Arrays {
            observation_dim: 1,
            action_dim: 1,
            observations: vec![0.0, 0.1, 0.2, -0.1, -0.2, -0.3],
            actions: vec![0.1; 6],
            rewards: vec![reward; 6],
            next_observations: vec![0.1, 0.2, 0.3, -0.2, -0.3, -0.4],
            terminals: vec![false, false, true, false, false, false],
            timeouts: vec![false, false, false, false, false, true],
        });
        let units = Units::new(&transitions.unwrap(), 0.5);
        assert_eq!((units.offset, units.least, units.most), (offset, least, most));
    }
}
