//! Tests: the update against an independent implementation (docs/golden.md).

use super::*;
use crate::algorithms::golden::{
    Golden, check_update, devices, fresh, golden_batch, golden_setting, golden_table, goldens,
};
use candle_core::Device;
use quad_policy::{Header, Precision, load_policy};

#[test]
fn golden_update() {
    for golden in goldens("iql") {
        devices().iter().for_each(|device| check(&golden, device));
    }
}

#[test]
fn golden_update_of_a_fresh_seed() {
    if let Some(golden) = fresh("iql") {
        devices().iter().for_each(|device| check(&golden, device));
    }
}

fn check(golden: &Golden, device: &Device) {
    let config: Config = read(&golden_table(golden)).unwrap();
    let mut iql = Iql::new(config, golden_setting(golden, device)).unwrap();
    let mut state = golden.state.clone();
    iql.load(&mut state).unwrap();
    assert!(state.is_empty(), "tensors that are not read: {:?}", state.keys());

    let (policy, tensors) = iql.policy().unwrap();
    let file = Header { policy, origin: () }.to_safetensors(&tensors).unwrap();
    let policy = load_policy(&file, Precision::F32).unwrap();
    let observations = golden.input("select_observations", &Device::Cpu);
    let n = observations.dim(0).unwrap();
    let observations: Vec<f32> = observations.flatten_all().unwrap().to_vec1().unwrap();
    let mut states: Vec<_> = (0..n as u64).map(|seed| policy.begin(seed)).collect();
    let mut actions = vec![0.0; n * policy.action_dim()];
    policy.act(&observations, &mut states, &mut actions).unwrap();
    golden.close("select.actions", &Tensor::new(actions, &Device::Cpu).unwrap());

    let values = iql.update(golden.count("/step") as u64, &golden_batch(golden, device)).unwrap();
    check_update(golden, METRICS, &values, iql.state().unwrap());
}
