//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::*;
use crate::algorithm::Algorithm;
use crate::golden::{
    Golden, batch, check_candidates, check_update, context, denoising, golden_tests, load, table,
};
use candle_core::Device;

fn start(golden: &Golden, device: &Device) -> Diffusion<AlignIql> {
    let rule = if golden.config["algorithm"] == "idql" { Rule::Best } else { Rule::Nearest };
    read::<Config>(&table(golden)).unwrap().start(rule, context(golden, device)).unwrap()
}

pub(crate) fn check(golden: &Golden, device: &Device) {
    let mut align_iql = start(golden, device);
    load(golden, align_iql.parts());
    check_choice(golden, &align_iql);
    let networks = &align_iql.networks;
    let (batch, noise) = (batch(golden, &networks.context), denoising(golden, device));
    golden.close("noisy_actions", &networks.denoise(&batch, &noise).unwrap().0);
    let measured = align_iql.step(golden.count("/step") as u64, &(batch, noise)).unwrap();
    check_update(golden, METRICS, &measured, align_iql.parts().save().unwrap());
}

/// What the published networks say of the candidates, and that the one whose Q is nearest to V, or
/// largest, is to be taken.
fn check_choice(golden: &Golden, align_iql: &Diffusion<AlignIql>) {
    let drawn = check_candidates(golden, align_iql);
    let candidates = golden.count("/agent/candidates") as u32;
    assert_eq!(
        drawn.choice,
        Choice { candidates, value: Aggregate::Min, rule: align_iql.update.rule }
    );
    let index = match &drawn.v {
        Some(v) => {
            golden.close("select.v", v);
            drawn
                .q
                .broadcast_sub(&v.unsqueeze(1).unwrap())
                .unwrap()
                .abs()
                .unwrap()
                .argmin(1)
                .unwrap()
        }
        None => drawn.q.argmax(1).unwrap(),
    };
    assert_eq!(drawn.v.is_some(), align_iql.update.rule == Rule::Nearest);
    golden.close("select.index", &index);
    let first = (0..index.elem_count()).map(|state| state as u32 * candidates);
    let rows: Vec<u32> =
        first.zip(index.to_vec1::<u32>().unwrap()).map(|(first, chosen)| first + chosen).collect();
    let rows = candle_core::Tensor::new(rows, &Device::Cpu).unwrap();
    golden.close("select.actions", &drawn.candidates.index_select(&rows, 0).unwrap());
}

golden_tests!("align-iql", check);
