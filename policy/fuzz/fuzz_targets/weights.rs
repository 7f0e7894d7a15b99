//! Policies from whatever the fuzzer makes of a small policy's file. What can be loaded can act.
#![no_main]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

use candle_core::{Device, Tensor};
use libfuzzer_sys::fuzz_target;
use quad_nn::{Affine, Layout, MlpConfig, Precision, Scaling};
use quad_policy::{ActorCriticShape, Choice, DiffusionShape, GaussianShape, Header, PolicyConfig, Rule, ScorePolicyShape, load_policy};

const STATES: usize = 2;
/// Policies that take more memory than this for an action take much time, too: they are only
/// loaded. Bytes.
const MOST_MEMORY: u64 = 1 << 20;

/// Policies for the fuzzer to begin with, where cargo-fuzz lets it look for some.
fn write_seeds() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/weights");
    fs::create_dir_all(&corpus).unwrap();
    let file = |policy: PolicyConfig, scaling| {
        let halves = |layout: &Layout| Tensor::full(0.5f32, layout.count(), &Device::Cpu);
        let tensors = policy.tensors(halves).unwrap();
        Header { scaling, ..Header::new(policy, ()) }.to_safetensors(&tensors).unwrap()
    };
    let layers = MlpConfig::mish(&[2; 3]);
    let diffusion = |rule: Rule| {
        let value = (rule == Rule::Nearest).then(|| layers.clone());
        let shape = DiffusionShape { value, ..DiffusionShape::quad((2, 1), &layers, 2, 2) };
        file(PolicyConfig::Diffusion { shape, choice: Choice { rule, ..Choice::best_of(2) } }, None)
    };
    let (best, nearest) = (diffusion(Rule::Best), diffusion(Rule::Nearest));
    let softmax = diffusion(Rule::Softmax { temperature: 0.5 });
    let (actor, critic) = (layers.clone(), MlpConfig { norm: true, ..layers.clone() });
    let shape = ActorCriticShape { observation_dim: 2, action_dim: 1, actor, critic, critics: 2 };
    let choice = Choice { rule: Rule::Softmax { temperature: 0.5 }, ..Choice::best_of(2) };
    let squashed = file(PolicyConfig::Squashed { shape, choice }, None);
    let (actor, critic) = (layers.clone(), layers.clone());
    let shape =
        ScorePolicyShape { observation_dim: 2, action_dim: 1, actor, critic, evaluations: 2 };
    let rule = Rule::Average { temperature: 0.5, actions: 2 };
    let score =
        file(PolicyConfig::Score { shape, choice: Choice { rule, ..Choice::best_of(3) } }, None);
    let shape = GaussianShape { observation_dim: 2, action_dim: 1, actor: layers.clone() };
    let actions = Some(Affine { offset: vec![3.0], scale: vec![2.0] });
    let gaussian =
        file(PolicyConfig::Gaussian { shape }, Some(Scaling { observations: None, actions }));
    let drawn = [
        ("best", best),
        ("nearest", nearest),
        ("softmax", softmax),
        ("squashed", squashed),
        ("score", score),
    ];
    for (name, file) in drawn.into_iter().chain([("gaussian", gaussian)]) {
        fs::write(corpus.join(name), file).unwrap();
    }
}

fuzz_target!(init: write_seeds(), |file: &[u8]| {
    let Ok(policy) = load_policy(file, Precision::F32) else { return };
    // As an evaluator asks before its largest job.
    policy.memory(256);
    if policy.memory(STATES) > MOST_MEMORY {
        return;
    }
    let observations = vec![0.5; STATES * policy.observation_dim()];
    let mut actions = vec![0.0; STATES * policy.action_dim()];
    let mut states = [1, 2].map(|seed| policy.begin(seed));
    // That a number is not finite is an answer, too.
    policy.act(&observations, &mut states, &mut actions).ok();
});
