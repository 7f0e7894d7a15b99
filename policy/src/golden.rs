//! Tests: the sampler and acting by the best of several candidates, against an independent implementation
//! (docs/golden.md).

#[path = "../../tests/golden/golden.rs"]
mod reader;

use crate::diffusion::DiffusionPolicy;
use crate::{DiffusionShape, NoisePredictor, Precision, Weights};
use candle_core::{Device, Tensor};
use reader::{Golden, goldens};

fn shape(golden: &Golden) -> DiffusionShape {
    DiffusionShape {
        observation_dim: golden.count("/observation_dim"),
        action_dim: golden.count("/action_dim"),
        hidden: golden.count("/agent/hidden"),
        critics: golden.count("/agent/critics"),
        diffusion_steps: golden.count("/agent/diffusion_steps"),
    }
}

#[test]
fn golden_reverse_steps() {
    for golden in goldens("quad") {
        let shape = shape(&golden).actor();
        let values = shape.layout().join(&mut golden.state.clone(), "target_actor.").unwrap();
        let actor = NoisePredictor::new(shape, Weights::constant(shape.layout(), values), Precision::F32);
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
