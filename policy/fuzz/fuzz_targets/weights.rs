//! Policies from the fuzzer's changes to small policies' files. A policy that loads can act.
#![no_main]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

use candle_core::{Device, Tensor};
use libfuzzer_sys::fuzz_target;
use quad_nn::{Affine, Layout, MlpConfig, Precision, Scaling};
use quad_policy::{
    ActorCriticShape, Choice, DiffusionShape, GaussianShape, Header, PolicyConfig, Rule,
    ScorePolicyShape, Spread, load_policy,
};

const STATES: usize = 2;
/// Policies that need more memory for an action also need much time, and are only loaded. Bytes.
const MOST_MEMORY: u64 = 1 << 20;

/// Writes policies to begin with into cargo-fuzz's corpus.
fn write_seeds() {
    let layers = MlpConfig::mish(&[2; 3]);
    let (observation_dim, action_dim) = (2, 1);
    let (actor, critic) = (layers.clone(), layers.clone());
    let choice = |rule| Choice { rule, ..Choice::best_of(3) };
    let softmax = choice(Rule::Softmax { temperature: 0.5 });
    let diffusion = |choice: Choice| {
        let value = (choice.rule == Rule::Nearest).then(|| layers.clone());
        let shape = DiffusionShape { value, ..DiffusionShape::quad((2, 1), &layers, 2, 2) };
        PolicyConfig::Diffusion { shape, choice }
    };
    let normed = MlpConfig { norm: true, ..layers.clone() };
    let squashed = ActorCriticShape {
        observation_dim,
        action_dim,
        actor: layers.clone(),
        critic: normed,
        critics: 2,
    };
    let score = ScorePolicyShape { observation_dim, action_dim, actor, critic, evaluations: 2 };
    let average = choice(Rule::Average { temperature: 0.5, actions: 2 });
    let gaussian = |spread| PolicyConfig::Gaussian {
        shape: GaussianShape { observation_dim, action_dim, actor: layers.clone(), spread },
    };
    let actions = Some(Affine { offset: vec![3.0], scale: vec![2.0] });
    let scaling = Some(Scaling { actions, ..Scaling::default() });
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/weights");
    fs::create_dir_all(&corpus).unwrap();
    for (name, policy, scaling) in [
        ("best", diffusion(choice(Rule::Best)), None),
        ("nearest", diffusion(choice(Rule::Nearest)), None),
        ("softmax", diffusion(softmax), None),
        ("squashed", PolicyConfig::Squashed { shape: squashed, choice: softmax }, None),
        ("score", PolicyConfig::Score { shape: score, choice: average }, None),
        ("gaussian", gaussian(Spread::Shared), scaling),
        ("gaussian-squashed", gaussian(Spread::Squashed), None),
    ] {
        let halves = |layout: &Layout| Tensor::full(0.5f32, layout.count(), &Device::Cpu);
        let tensors = policy.tensors(halves).unwrap();
        let header = Header { scaling, ..Header::new(policy, ()) };
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
