//! Policies from whatever the fuzzer makes of a small policy's file. What can be loaded can act.
#![no_main]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use libfuzzer_sys::fuzz_target;
use quad_policy::{
    ActionNoise, Description, DiffusionPolicy, DiffusionShape, Ensemble, GaussianPolicy, GaussianShape, Layout,
    NoisePredictor, Precision, Weights, load_policy,
};

const STATES: usize = 2;
const CANDIDATES: usize = 2;
/// Policies that take more than this for an action are only loaded.
const MOST_PRODUCTS: u64 = 1 << 20;

/// Policies for the fuzzer to begin with, where cargo-fuzz lets it look for some.
fn write_seeds() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/weights");
    fs::create_dir_all(&corpus).unwrap();
    let halves = |layout: Layout| {
        let values = Tensor::full(0.5f32, layout.count(), &Device::Cpu).unwrap().to_dtype(DType::F32).unwrap();
        Weights::constant(layout, values)
    };
    let shape = DiffusionShape { observation_dim: 2, action_dim: 1, hidden: 2, critics: 2, diffusion_steps: 2 };
    let actor = NoisePredictor::new(shape.actor(), halves(shape.actor().layout()), Precision::F32);
    let critics = Ensemble::new(shape.critics(), halves(shape.critics().layout()), Precision::F32);
    let diffusion = DiffusionPolicy::tensors(&actor, &critics).unwrap();
    let diffusion = Description::Diffusion(shape).to_safetensors(&diffusion).unwrap();
    let shape = GaussianShape { observation_dim: 2, action_dim: 1, hidden: 2 };
    let actor = Ensemble::new(shape.actor(), halves(shape.actor().layout()), Precision::F32);
    let gaussian = Description::Gaussian(shape).to_safetensors(&GaussianPolicy::tensors(&actor).unwrap()).unwrap();
    for (name, file) in [("diffusion", diffusion), ("gaussian", gaussian)] {
        fs::write(corpus.join(name), file).unwrap();
    }
}

fuzz_target!(init: write_seeds(), |file: &[u8]| {
    let Ok(policy) = load_policy(file, Precision::F32) else { return };
    // As an evaluator asks before its largest job.
    policy.cost(256, 256);
    if policy.cost(STATES, CANDIDATES).products > MOST_PRODUCTS {
        return;
    }
    let observations = vec![0.5; STATES * policy.observation_dim()];
    let mut actions = vec![0.0; STATES * policy.action_dim()];
    let mut noise = [1, 2].map(ActionNoise::new);
    // That a number is not finite is an answer, too.
    policy.act(&observations, CANDIDATES, &mut noise, &mut actions).ok();
});
