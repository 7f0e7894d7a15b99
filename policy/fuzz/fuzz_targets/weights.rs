//! Policies from the fuzzer's changes to small policies' files. A policy that loads can act.
#![no_main]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

use candle_core::{Device, Tensor};
use libfuzzer_sys::fuzz_target;
use quad_nn::{Layout, MlpConfig, Precision, Scaling};
use quad_policy::{
    Choice, DiffusionShape, GaussianShape, Header, PolicyConfig, Rule, Spread, load_policy,
};

const STATES: usize = 2;
/// Policies that need more memory for an action also need much time, and are only loaded. Bytes.
const MOST_MEMORY: u64 = 1 << 20;

/// Writes policies to begin with into cargo-fuzz's corpus.
fn write_seeds() {
    let layers = MlpConfig::mish(&[2; 3]);
    let mut shape = DiffusionShape::quad((2, 1), &layers, 2, 2);
    shape.value = Some(layers.clone());
    let mut choice = Choice::best_of(3);
    choice.rule = Rule::Nearest;
    let nearest = PolicyConfig::Diffusion { shape, choice };
    let shape = GaussianShape {
        observation_dim: 2,
        action_dim: 1,
        actor: layers,
        spread: Spread::Shared,
    };
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/weights");
    fs::create_dir_all(&corpus).unwrap();
    for (name, policy) in [("nearest", nearest), ("gaussian", PolicyConfig::Gaussian { shape })] {
        let halves = |layout: &Layout| Tensor::full(0.5f32, layout.count(), &Device::Cpu);
        let tensors = policy.tensors(halves).unwrap();
        let mut header = Header::new(policy, ());
        header.scaling = Some(Scaling::default());
        fs::write(corpus.join(name), header.to_safetensors(&tensors).unwrap()).unwrap();
    }
}

fuzz_target!(init: write_seeds(), |file: &[u8]| {
    let Ok(policy) = load_policy(file, Precision::F32) else { return };
    // As an evaluator does before its largest job.
    policy.memory(256);
    if policy.memory(STATES) > MOST_MEMORY {
        return;
    }
    let observations = vec![0.5; STATES * policy.observation_dim()];
    let mut actions = vec![0.0; STATES * policy.action_dim()];
    let mut states = [1, 2].map(|seed| policy.begin(seed));
    // A NaN is an error, too.
    policy.act(&observations, &mut states, &mut actions).ok();
});
