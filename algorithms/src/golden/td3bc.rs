//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::*;
use crate::golden::{Golden, batch, check_actions, check_update, context, golden_tests, load, table};
use candle_core::Device;

golden_tests!("td3-bc", check);

fn check(golden: &Golden, device: &Device) {
    let mut td3_bc = Td3Bc::new(read(&table(golden)).unwrap(), context(golden, device)).unwrap();
    load(golden, td3_bc.parts());
    check_actions(golden, &td3_bc);
    let batch = batch(golden, &td3_bc.context);
    let step = golden.count("/step") as u64;
    let measured = td3_bc.step(step, &batch, &golden.input("target_noise", device)).unwrap();
    check_update(golden, METRICS, &measured, td3_bc.parts().save().unwrap());
}
