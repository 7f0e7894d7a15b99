//! Tests: the update against an independent implementation (docs/golden.md).

use super::*;
use crate::algorithms::golden::{
    Golden, check_update, devices, fresh, golden_batch, golden_setting, golden_table, goldens,
};
use candle_core::Device;
use quad_policy::{ActionNoise, Precision, load_policy};

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

    let (description, tensors) = iql.policy().unwrap();
    let policy = load_policy(&description.to_safetensors(&tensors).unwrap(), Precision::F32).unwrap();
    let observations = golden.input("select_observations", &Device::Cpu);
    let n = observations.dim(0).unwrap();
    let observations: Vec<f32> = observations.flatten_all().unwrap().to_vec1().unwrap();
    let mut noise: Vec<_> = (0..n as u64).map(ActionNoise::new).collect();
    let mut actions = vec![0.0; n * policy.action_dim()];
    policy.act(&observations, 1, &mut noise, &mut actions).unwrap();
    golden.close("select.actions", &Tensor::new(actions, &Device::Cpu).unwrap());

    let values = iql.update(golden.count("/step") as u64, &golden_batch(golden, device)).unwrap();
    check_update(golden, METRICS, &values, iql.state().unwrap());
}
