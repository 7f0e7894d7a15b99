//! Tests: the sampler and acting by the best of several candidates, against an independent implementation
//! (docs/golden.md).

#[path = "../../tests/golden/golden.rs"]
mod reader;

use crate::choice::{Choice, Reduce, Rule};
use crate::diffusion::{DiffusionPolicy, DiffusionShape};
use crate::ensemble::Ensemble;
use crate::error::PolicyError;
use crate::kind::{Header, PolicyConfig, load_policy};
use crate::mlp_config::MlpConfig;
use crate::noise_predictor::NoisePredictor;
use crate::policy::Policy;
use crate::precision::Precision;
use crate::schedule::Reverse;
use crate::weights::{Layout, Tensors, Weights};
use candle_core::{Device, Tensor};
use reader::{Golden, goldens};

fn layers(golden: &Golden, pointer: &str) -> MlpConfig {
    serde_json::from_value(golden.config.pointer(pointer).unwrap().clone()).unwrap()
}

fn shape(golden: &Golden) -> DiffusionShape {
    DiffusionShape {
        observation_dim: golden.count("/observation_dim"),
        action_dim: golden.count("/action_dim"),
        actor: layers(golden, "/agent/actor"),
        critic: layers(golden, "/agent/critic"),
        value: None,
        critics: golden.count("/agent/critics"),
        diffusion_steps: golden.count("/agent/diffusion_steps"),
        reverse: Reverse::ClipClean,
    }
}

fn file(shape: DiffusionShape, choice: Choice, tensors: &Tensors) -> Vec<u8> {
    Header { policy: PolicyConfig::Diffusion { shape, choice }, origin: () }.to_safetensors(tensors).unwrap()
}

#[test]
fn golden_reverse_steps() {
    for golden in goldens("quad") {
        let shape = shape(&golden).actor();
        let values = shape.layout().join(&mut golden.state.clone(), "target_actor.").unwrap();
        let weights = Weights::constant(shape.layout(), values);
        let actor = NoisePredictor::new(shape.clone(), weights, Precision::F32);
        let observations = golden.input("observations", &Device::Cpu);
        let rows = observations.dim(0).unwrap();
        let step = |t: usize| {
            let x = golden.input("denoise_actions", &Device::Cpu).get(t - 1).unwrap();
            let all = Tensor::full(t as u32, rows, &Device::Cpu).unwrap();
            let epsilon = actor.predict(&observations, &x, &all).unwrap();
            let clean = actor.schedule().clean(t, &x, &epsilon).unwrap();
            (clean, actor.schedule().reverse(t, &x, &epsilon, None).unwrap())
        };
        let (clean, mean): (Vec<_>, Vec<_>) = (1..=shape.diffusion_steps).map(step).unzip();
        golden.close("denoise.x0", &Tensor::stack(&clean, 0).unwrap());
        golden.close("denoise.mean", &Tensor::stack(&mean, 0).unwrap());
    }
}

#[test]
fn golden_choices() {
    for golden in goldens("quad") {
        let (shape, candidates) = (shape(&golden), golden.count("/agent/candidates"));
        let choice = Choice::best_of(candidates as u32);
        let network =
            |(name, tensor): (&String, &Tensor)| Some((name.strip_prefix("target_")?.to_owned(), tensor.clone()));
        let mut tensors = golden.state.iter().filter_map(network).collect();
        let policy = DiffusionPolicy::load(shape.clone(), choice, &mut tensors, Precision::F32).unwrap();
        let numbers = |name: &str| golden.input(name, &Device::Cpu).flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let (observations, noise) = (numbers("select_observations"), numbers("select_noise"));
        let (drawn, values) = policy.draw(&observations, noise).unwrap();
        let chosen = |values| choice.pick(values, &mut policy.begin(0)).unwrap();
        let chosen: Vec<usize> = values.chunks_exact(candidates).map(chosen).collect();
        let drawn: Vec<&[f32]> = drawn.chunks_exact(policy.action_dim()).collect();
        let taken = chosen.iter().enumerate().map(|(i, chosen)| drawn[i * candidates + chosen]);
        let actions = taken.flatten().copied().collect();
        let tensor = |x: Vec<f32>| Tensor::new(x, &Device::Cpu).unwrap();
        golden.close("select.q", &tensor(values));
        golden.close("select.actions", &tensor(actions));
        let index: Vec<i64> = golden.expected["select.index"].to_vec1().unwrap();
        assert!(chosen.iter().zip(&index).all(|(found, expected)| *found as i64 == *expected), "{chosen:?} {index:?}");
    }
}

fn small(critics: usize) -> DiffusionShape {
    DiffusionShape::quad((4, 2), &MlpConfig::mish(&[8; 3]), critics, 2)
}

/// Finite weights so large that values overflow: the error says what is not a number, and nothing is chosen.
#[test]
fn a_candidate_without_a_value_is_an_error() {
    let shape = small(3);
    // Of both signs, so that infinities meet.
    let constant = |layout: Layout, size: f32| {
        let values = (0..layout.count()).map(|i| if i / 3 % 2 == 0 { size } else { -size });
        Weights::constant(layout.clone(), Tensor::from_iter(values, &Device::Cpu).unwrap())
    };
    let policy = |actor: f32, critics: f32| {
        let actor = NoisePredictor::new(shape.actor(), constant(shape.actor().layout(), actor), Precision::F32);
        let critics = Ensemble::new(shape.critics(), constant(shape.critics().layout(), critics), Precision::F32);
        let tensors = DiffusionPolicy::tensors(&actor, &critics, None).unwrap();
        load_policy(&file(shape.clone(), Choice::best_of(5), &tensors), Precision::F32).unwrap()
    };
    let act = |policy: &dyn Policy, observations: &[f32]| {
        let mut actions = vec![0.0; 2];
        policy.act(observations, &mut [policy.begin(0)], &mut actions).map(|()| actions)
    };
    assert!(act(&*policy(0.1, 0.1), &[1.0; 4]).is_ok());
    let value = act(&*policy(0.1, 1e38), &[1.0, -1.0, 1.0, 1.0]).unwrap_err().to_string();
    assert!(value.contains("value of a candidate is not a number"), "{value}");
    let mut one = policy(0.1, 1e38);
    one.choose(Choice::best_of(1)).unwrap();
    assert!(act(&*one, &[1.0, -1.0, 1.0, 1.0]).is_ok(), "of one candidate the critics are not asked");
    let action = act(&*policy(0.1, 0.1), &[f32::NAN, 0.0, 0.0, 0.0]).unwrap_err().to_string();
    assert!(action.contains("not a number"), "{action}");
}

/// Shapes come from strangers: none may ask for unbounded memory, whatever it wraps around to.
#[test]
fn a_shape_out_of_range_is_refused() {
    let good = small(3);
    let refused = |shape: DiffusionShape| {
        let file = file(shape, Choice::best_of(1), &Tensors::new());
        matches!(load_policy(&file, Precision::F32), Err(PolicyError::Range { .. }))
    };
    for steps in [0, 1001, (1 << 58) + 1, usize::MAX] {
        assert!(refused(DiffusionShape { diffusion_steps: steps, ..good.clone() }), "{steps} denoising steps");
    }
    assert!(refused(DiffusionShape { critics: 0, ..good.clone() }));
    assert!(!refused(good), "it lacks its tensors, but its shape is one");
}

/// A diffusion policy of constants: its value function says `v` in every state, its critics say so of every action, plus what
/// the kernels make of it.
fn constant(choice: Choice, critic: f32, v: f32) -> Result<Box<dyn Policy>, PolicyError> {
    let shape = DiffusionShape { value: (v != 0.0).then(|| small(2).critic), ..small(2) };
    let weights = |layout: Layout, each: f32, last: f32| {
        let count = layout.count();
        let values = (0..count).map(|i| if i + 1 == count { last } else { each });
        Weights::constant(layout, Tensor::from_iter(values, &Device::Cpu).unwrap())
    };
    let actor = NoisePredictor::new(shape.actor(), weights(shape.actor().layout(), 0.05, 0.05), Precision::F32);
    let critics = Ensemble::new(shape.critics(), weights(shape.critics().layout(), critic, critic), Precision::F32);
    let value = shape.value().map(|of| Ensemble::new(of.clone(), weights(of.layout(), 0.0, v), Precision::F32));
    let tensors = DiffusionPolicy::tensors(&actor, &critics, value.as_ref()).unwrap();
    load_policy(&file(shape, choice, &tensors), Precision::F32)
}

/// What it does at the first step of an episode.
fn first_action(policy: &dyn Policy) -> Vec<f32> {
    let mut actions = vec![0.0; 2];
    policy.act(&[0.5; 4], &mut [policy.begin(3)], &mut actions).unwrap();
    actions
}

#[test]
fn the_file_s_rule_chooses_unless_another_is_asked_for() {
    let best = Choice { value: Reduce::Min, ..Choice::best_of(8) };
    let nearest = Choice { rule: Rule::Nearest, ..best };
    // A value above that of all actions: the nearest is the best. Below: the worst.
    let (high, low) = (constant(nearest, 0.1, 1e3).unwrap(), constant(nearest, 0.1, -1e3).unwrap());
    let mut policy = constant(best, 0.1, 0.0).unwrap();
    assert_eq!(policy.choice(), Some(best));
    assert_eq!(first_action(&*policy), first_action(&*high));
    assert_ne!(first_action(&*policy), first_action(&*low));
    let cold = Choice { rule: Rule::Softmax { temperature: 1e-6 }, ..best };
    policy.choose(cold).unwrap();
    assert_eq!((policy.choice(), first_action(&*policy)), (Some(cold), first_action(&*high)));
    policy.choose(Choice { rule: Rule::Softmax { temperature: 1e6 }, ..best }).unwrap();
    assert!(matches!(policy.choose(nearest), Err(PolicyError::NoValue)));
    assert!(matches!(policy.choose(Choice::best_of(1001)), Err(PolicyError::Range { .. })));
}

#[test]
fn the_rule_nearest_takes_a_value_function() {
    let nearest = Choice { rule: Rule::Nearest, ..Choice::best_of(8) };
    assert!(matches!(constant(nearest, 0.1, 0.0), Err(PolicyError::NoValue)));
}
