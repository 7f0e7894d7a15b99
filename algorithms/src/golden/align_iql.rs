//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::*;
use crate::algorithm::Algorithm;
use crate::golden::{Golden, batch, check_candidates, check_update, context, denoising, golden_tests, load, table};
use candle_core::Device;

fn start(golden: &Golden, device: &Device) -> Diffusion<AlignIql> {
    read::<Config>(&table(golden)).unwrap().start(context(golden, device)).unwrap()
}

fn check(golden: &Golden, device: &Device) {
    let mut align_iql = start(golden, device);
    load(golden, align_iql.parts());
    check_choice(golden, &align_iql);
    let networks = &align_iql.networks;
    let (batch, noise) = (batch(golden, &networks.context), denoising(golden, device));
    golden.close("noisy_actions", &networks.denoise(&batch, &noise).unwrap().0);
    let measured = align_iql.step(golden.count("/step") as u64, &(batch, noise)).unwrap();
    check_update(golden, METRICS, &measured, align_iql.parts().save().unwrap());
}

/// What the published networks say of the candidates, and that the one whose Q is nearest to V is to be taken.
fn check_choice(golden: &Golden, align_iql: &Diffusion<AlignIql>) {
    let drawn = check_candidates(golden, align_iql);
    let candidates = golden.count("/agent/candidates") as u32;
    assert_eq!(drawn.choice, Choice { candidates, value: Reduce::Min, rule: Rule::Nearest });
    let v = drawn.v.unwrap();
    golden.close("select.v", &v);
    let index = drawn.q.broadcast_sub(&v.unsqueeze(1).unwrap()).unwrap().abs().unwrap().argmin(1).unwrap();
    golden.close("select.index", &index);
    let first = (0..v.elem_count()).map(|state| state as u32 * candidates);
    let rows: Vec<u32> = first.zip(index.to_vec1::<u32>().unwrap()).map(|(first, chosen)| first + chosen).collect();
    let rows = candle_core::Tensor::new(rows, &Device::Cpu).unwrap();
    golden.close("select.actions", &drawn.candidates.index_select(&rows, 0).unwrap());
}

golden_tests!("align-iql", check);
