//! Policies from whatever the fuzzer makes of a small policy's file. What can be loaded can act.
#![no_main]
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use libfuzzer_sys::fuzz_target;
use quad_policy::{
    Affine, Choice, DiffusionPolicy, DiffusionShape, Ensemble, EnsembleShape, GaussianPolicy, GaussianShape, Header,
    Layout, MlpConfig, NoisePredictor, PolicyConfig, Precision, Rule, Scaling, ScoreNetwork, ScorePolicy, ScorePolicyShape,
    ScoreShape, SquashedPolicy, SquashedShape, Weights, load_policy,
};

const STATES: usize = 2;
/// Policies that take more memory than this for an action take much time, too: they are only loaded. Bytes.
const MOST_MEMORY: u64 = 1 << 20;

/// Policies for the fuzzer to begin with, where cargo-fuzz lets it look for some.
fn write_seeds() {
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/weights");
    fs::create_dir_all(&corpus).unwrap();
    let halves = |layout: Layout| {
        let values = Tensor::full(0.5f32, layout.count(), &Device::Cpu).unwrap().to_dtype(DType::F32).unwrap();
        Weights::constant(layout, values)
    };
    let layers = MlpConfig::mish(&[2; 3]);
    let with_value = DiffusionShape { value: Some(layers.clone()), ..DiffusionShape::quad((2, 1), &layers, 2, 2) };
    let diffusion = |rule: Rule| {
        let choice = Choice { rule, ..Choice::best_of(2) };
        let value = with_value.value.clone().filter(|_| rule == Rule::Nearest);
        let shape = DiffusionShape { value, ..with_value.clone() };
        let actor = NoisePredictor::new(shape.actor(), halves(shape.actor().layout()), Precision::F32);
        let ensemble = |of: EnsembleShape| Ensemble::new(of.clone(), halves(of.layout()), Precision::F32);
        let (critics, value) = (ensemble(shape.critics()), shape.value().map(ensemble));
        let tensors = DiffusionPolicy::tensors(&actor, &critics, value.as_ref()).unwrap();
        Header { policy: PolicyConfig::Diffusion { shape, choice }, scaling: None, origin: () }
            .to_safetensors(&tensors)
            .unwrap()
    };
    let (best, nearest) = (diffusion(Rule::Best), diffusion(Rule::Nearest));
    let softmax = diffusion(Rule::Softmax { temperature: 0.5 });
    let (actor, critic) = (layers.clone(), MlpConfig { norm: true, ..layers.clone() });
    let shape = SquashedShape { observation_dim: 2, action_dim: 1, actor, critic, critics: 2 };
    let [actor, critics] = [shape.actor(), shape.critics()].map(|of| {
        let weights = halves(of.layout());
        Ensemble::new(of, weights, Precision::F32)
    });
    let tensors = SquashedPolicy::tensors(&actor, &critics).unwrap();
    let choice = Choice { rule: Rule::Softmax { temperature: 0.5 }, ..Choice::best_of(2) };
    let squashed = Header { policy: PolicyConfig::Squashed { shape, choice }, scaling: None, origin: () };
    let squashed = squashed.to_safetensors(&tensors).unwrap();
    let shape = GaussianShape { observation_dim: 2, action_dim: 1, actor: layers.clone() };
    let actor = Ensemble::new(shape.actor(), halves(shape.actor().layout()), Precision::F32);
    let tensors = GaussianPolicy::tensors(&actor).unwrap();
    let score = ScorePolicyShape { observation_dim: 2, action_dim: 1, actor: layers.clone(), critic: layers, evaluations: 2 };
    let frequencies = Tensor::ones(ScoreShape::FREQUENCIES, DType::F32, &Device::Cpu).unwrap();
    let network = ScoreNetwork::new(score.actor(), halves(score.actor().layout()), frequencies);
    let critic = Ensemble::new(score.critic(), halves(score.critic().layout()), Precision::F32);
    let of_score = ScorePolicy::tensors(&network, &critic).unwrap();
    let rule = Rule::Average { temperature: 0.5, actions: 2 };
    let policy = PolicyConfig::Score { shape: score, choice: Choice { rule, ..Choice::best_of(3) } };
    let score = Header { policy, scaling: None, origin: () }.to_safetensors(&of_score).unwrap();
    let actions = Some(Affine { offset: vec![3.0], scale: vec![2.0] });
    let scaling = Some(Scaling { observations: None, actions });
    let gaussian = Header { policy: PolicyConfig::Gaussian { shape }, scaling, origin: () };
    let gaussian = gaussian.to_safetensors(&tensors).unwrap();
    let drawn = [("best", best), ("nearest", nearest), ("softmax", softmax), ("squashed", squashed), ("score", score)];
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
