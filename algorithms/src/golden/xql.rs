//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::*;
use crate::algorithm::Algorithm;
use crate::golden::{
    Golden, batch, check_actions, check_update, context, golden_tests, goldens, load, table,
};
use candle_core::Device;

fn check(golden: &Golden, device: &Device) {
    let config = read::<Config>(&table(golden)).unwrap();
    let mut xql = InSample::new(config, context(golden, device)).unwrap();
    load(golden, xql.parts());
    check_actions(golden, &xql);
    let input = |name: &str| golden.inputs.contains_key(name).then(|| golden.input(name, device));
    let noise = Noise { actions: input("random_actions"), normal: input("value_noise") };
    let batch = batch(golden, &xql.context);
    let pairs = xql.losses.pairs_with(&batch, &noise).unwrap();
    let measured = xql.step(golden.count("/step") as u64, &batch, Some(pairs)).unwrap();
    check_update(golden, METRICS, &measured, xql.parts().save().unwrap());
}

golden_tests!("xql", check);

/// Without extras V is fitted to the batch itself; with them the random numbers are the step's own.
#[test]
fn the_pairs_of_a_step_are_repeatable_and_no_other_steps() {
    for golden in goldens("xql") {
        let (config, context) =
            (read::<Config>(&table(&golden)).unwrap(), context(&golden, &Device::Cpu));
        let batch = batch(&golden, &context);
        let actions = |step| {
            let pairs = config.pairs(&context, step, &batch).unwrap();
            pairs.map(|(_, actions)| actions.to_vec2::<f32>().unwrap())
        };
        let extras = config.random_actions > 0;
        assert_eq!(actions(0).is_some(), extras);
        assert!(actions(0) == actions(0) && (actions(0) != actions(1)) == extras);
        assert!(actions(0).into_iter().flatten().flatten().all(|action| action.abs() <= 1.0));
    }
}
