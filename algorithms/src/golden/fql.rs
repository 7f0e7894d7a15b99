//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::*;
use crate::golden::{
    Golden, batch, check_candidates, check_update, context, golden_tests, load, table,
};
use candle_core::Device;

golden_tests!("fql", check);

fn check(golden: &Golden, device: &Device) {
    let mut fql = Fql::new(read(&table(golden)).unwrap(), context(golden, device)).unwrap();
    load(golden, fql.parts());
    let drawn = check_candidates(golden, &fql);
    assert_eq!(
        (drawn.choice.candidates as usize, drawn.choice.value),
        (golden.count("/agent/candidates"), fql.config.target)
    );
    let batch = batch(golden, &fql.context);
    let input = |name: &str| golden.input(name, device);
    let noise = Noise {
        start: input("start_noise"),
        times: input("times").unsqueeze(1).unwrap(),
        of_policy: input("policy_noise"),
        of_targets: input("next_noise"),
    };
    golden.close("flow_actions", &fql.flow_actions(&batch.observations, &noise.of_policy).unwrap());
    golden.close("targets", &fql.targets(&batch, &noise.of_targets).unwrap());
    let measured = fql.step(golden.count("/step") as u64, &batch, &noise).unwrap();
    check_update(golden, METRICS, &measured, fql.parts().save().unwrap());
}
