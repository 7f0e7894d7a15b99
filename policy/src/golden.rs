//! Tests: the sampler and acting by the best of several candidates, against an independent implementation
//! (docs/golden.md).

#[path = "../../tests/golden/golden.rs"]
mod reader;

use crate::diffusion::{DiffusionPolicy, DiffusionShape};
use crate::ensemble::Ensemble;
use crate::error::PolicyError;
use crate::kind::{Description, load_policy};
use crate::noise_predictor::NoisePredictor;
use crate::policy::{ActionNoise, Policy};
use crate::precision::Precision;
use crate::schedule::Reverse;
use crate::shape::MlpConfig;
use crate::weights::{Layout, Tensors, Weights};
use candle_core::{Device, Tensor};
use reader::{Golden, goldens};

fn layers(hidden: usize) -> MlpConfig {
    MlpConfig { hidden: vec![hidden; 3], ..MlpConfig::default() }
}

fn shape(golden: &Golden) -> DiffusionShape {
    DiffusionShape {
        observation_dim: golden.count("/observation_dim"),
        action_dim: golden.count("/action_dim"),
        actor: layers(golden.count("/agent/hidden")),
        critic: layers(golden.count("/agent/hidden")),
        critics: golden.count("/agent/critics"),
        diffusion_steps: golden.count("/agent/diffusion_steps"),
        reverse: Reverse::ClipClean,
    }
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
        let (shape, candidates) = (shape(&golden), golden.count("/candidates"));
        let network =
            |(name, tensor): (&String, &Tensor)| Some((name.strip_prefix("target_")?.to_owned(), tensor.clone()));
        let mut tensors = golden.state.iter().filter_map(network).collect();
        let policy = DiffusionPolicy::load(shape, &mut tensors, Precision::F32).unwrap();
        let numbers = |name: &str| golden.input(name, &Device::Cpu).flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let (observations, noise) = (numbers("select_observations"), numbers("select_noise"));
        let (actions, chosen, values) = policy.choose(&observations, candidates, noise).unwrap();
        let tensor = |x: Vec<f32>| Tensor::new(x, &Device::Cpu).unwrap();
        golden.close("select.q", &tensor(values));
        golden.close("select.actions", &tensor(actions));
        let index: Vec<i64> = golden.expected["select.index"].to_vec1().unwrap();
        assert!(chosen.iter().zip(&index).all(|(found, expected)| *found as i64 == *expected), "{chosen:?} {index:?}");
    }
}

fn small() -> DiffusionShape {
    DiffusionShape {
        observation_dim: 4,
        action_dim: 2,
        actor: layers(8),
        critic: layers(8),
        critics: 3,
        diffusion_steps: 2,
        reverse: Reverse::ClipClean,
    }
}

/// Finite weights so large that values overflow: the error says what is not a number, and nothing is chosen.
#[test]
fn a_candidate_without_a_value_is_an_error() {
    let shape = small();
    // Of both signs, so that infinities meet.
    let constant = |layout: Layout, size: f32| {
        let values = (0..layout.count()).map(|i| if i / 3 % 2 == 0 { size } else { -size });
        Weights::constant(layout.clone(), Tensor::from_iter(values, &Device::Cpu).unwrap())
    };
    let policy = |actor: f32, critics: f32| {
        let actor = NoisePredictor::new(shape.actor(), constant(shape.actor().layout(), actor), Precision::F32);
        let critics = Ensemble::new(shape.critics(), constant(shape.critics().layout(), critics), Precision::F32);
        let tensors = DiffusionPolicy::tensors(&actor, &critics).unwrap();
        let bytes = Description::Diffusion(shape.clone()).to_safetensors(&tensors).unwrap();
        load_policy(&bytes, Precision::F32).unwrap()
    };
    let act = |policy: &dyn Policy, observations: &[f32]| {
        let mut actions = vec![0.0; 2];
        policy.act(observations, 5, &mut [ActionNoise::new(0)], &mut actions).map(|()| actions)
    };
    assert!(act(&*policy(0.1, 0.1), &[1.0; 4]).is_ok());
    let value = act(&*policy(0.1, 1e38), &[1.0, -1.0, 1.0, 1.0]).unwrap_err().to_string();
    assert!(value.contains("value of a candidate is not a number"), "{value}");
    let action = act(&*policy(0.1, 0.1), &[f32::NAN, 0.0, 0.0, 0.0]).unwrap_err().to_string();
    assert!(action.contains("not a number"), "{action}");
}

/// Shapes come from strangers: none may ask for unbounded memory, whatever it wraps around to.
#[test]
fn a_shape_out_of_range_is_refused() {
    let good = small();
    let refused = |shape: DiffusionShape| {
        let bytes = Description::Diffusion(shape).to_safetensors(&Tensors::new()).unwrap();
        matches!(load_policy(&bytes, Precision::F32), Err(PolicyError::Range { .. }))
    };
    for steps in [0, 1001, (1 << 58) + 1, usize::MAX] {
        assert!(refused(DiffusionShape { diffusion_steps: steps, ..good.clone() }), "{steps} denoising steps");
    }
    assert!(
        refused(DiffusionShape { critic: layers(usize::MAX), ..good.clone() })
            && refused(DiffusionShape { critics: 0, ..good.clone() })
    );
    assert!(!refused(good), "it lacks its tensors, but its shape is one");
}
