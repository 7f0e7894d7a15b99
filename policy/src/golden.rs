//! Tests: reverse steps and the choice among candidates against an independent implementation
//! (tests/golden/README.md).

#[path = "../../tests/golden/golden.rs"]
mod reader;

use crate::kinds::diffusion::{DiffusionPolicy, DiffusionShape};
use crate::policy::Policy;
use crate::sampling::choice::Choice;
use candle_core::{Device, Result, Tensor};
use quad_nn::{MlpConfig, NoisePredictor, Precision, Reverse, Weights};
use reader::{Golden, goldens};

fn shape(golden: &Golden) -> DiffusionShape {
    let layers = |pointer: &str| -> MlpConfig {
        serde_json::from_value(golden.config.pointer(pointer).unwrap().clone()).unwrap()
    };
    DiffusionShape {
        observation_dim: golden.count("/observation_dim"),
        action_dim: golden.count("/action_dim"),
        actor: layers("/agent/actor"),
        critic: layers("/agent/critic"),
        value: None,
        critics: golden.count("/agent/critics"),
        diffusion_steps: golden.count("/agent/diffusion_steps"),
        reverse: Reverse::ClipClean,
    }
}

#[test]
fn golden_reverse_steps() -> Result<()> {
    for golden in goldens("quad") {
        let shape = shape(&golden).actor();
        let weights =
            Weights::take(shape.layout(), &mut golden.state.clone(), "target_actor.").unwrap();
        let actor = NoisePredictor::new(shape.clone(), weights, Precision::F32);
        let observations = golden.input("observations", &Device::Cpu);
        let rows = observations.dim(0)?;
        let (mut clean, mut mean) = (Vec::new(), Vec::new());
        for t in 1..=shape.diffusion_steps {
            let x = golden.input("denoise_actions", &Device::Cpu).get(t - 1)?;
            let all = Tensor::full(t as u32, rows, &Device::Cpu)?;
            let epsilon = actor.predict(&observations, &x, &all)?;
            clean.push(actor.schedule().clean(t, &x, &epsilon)?);
            mean.push(actor.schedule().reverse(t, &x, &epsilon, None)?);
        }
        golden.close("denoise.x0", &Tensor::stack(&clean, 0)?);
        golden.close("denoise.mean", &Tensor::stack(&mean, 0)?);
    }
    Ok(())
}

#[test]
fn golden_choices() -> Result<()> {
    for golden in goldens("quad") {
        let candidates = golden.count("/agent/candidates");
        let choice = Choice::best_of(candidates as u32);
        let network = |(name, tensor): (&String, &Tensor)| {
            Some((name.strip_prefix("target_")?.to_owned(), tensor.clone()))
        };
        let load = |choice| {
            let mut tensors = golden.state.iter().filter_map(network).collect();
            DiffusionPolicy::load(&shape(&golden), choice, &mut tensors, Precision::F32).unwrap()
        };
        let policy = load(choice);
        let numbers = |name: &str| golden.input(name, &Device::Cpu).flatten_all()?.to_vec1::<f32>();
        let observations = numbers("select_observations")?;
        let (drawn, values) = policy.draw(&observations, numbers("select_noise")?).unwrap();
        let chosen = |values| choice.pick(values, &mut policy.begin(0)).unwrap()[0];
        let chosen: Vec<usize> = values.chunks_exact(candidates).map(chosen).collect();
        let drawn: Vec<&[f32]> = drawn.chunks_exact(policy.action_dim()).collect();
        let taken = chosen.iter().enumerate().map(|(i, chosen)| drawn[i * candidates + chosen]);
        let actions: Vec<f32> = taken.flatten().copied().collect();
        golden.close("select.q", &Tensor::new(values, &Device::Cpu)?);
        golden.close("select.actions", &Tensor::new(actions, &Device::Cpu)?);
        let index: Vec<i64> = golden.expected["select.index"].to_vec1()?;
        assert_eq!(chosen.iter().map(|chosen| *chosen as i64).collect::<Vec<_>>(), index);
        if golden.inputs.contains_key("select_guidance") {
            let guidance = numbers("select_guidance")?[0];
            let guided = load(Choice { guidance, ..choice });
            let (drawn, _) = guided.draw(&observations, numbers("select_noise")?).unwrap();
            golden.close("select.guided", &Tensor::new(drawn, &Device::Cpu)?);
        }
    }
    Ok(())
}
