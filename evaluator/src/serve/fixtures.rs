//! What tests of this room are made of.

use candle_core::{DType, Device, Tensor};
use quad_policy::{Description, DiffusionPolicy, DiffusionShape, Ensemble, Layout, NoisePredictor, Precision, Weights};
use quad_protocol::{Hash, Job, Name, Schema, Snapshot};

/// Two episodes of Hopper.
pub fn job() -> Job {
    Job {
        id: 1,
        run: Name::new("run").unwrap(),
        incarnation: 1,
        step: 1,
        weights: Hash::of(b""),
        environment: "hopper".to_owned(),
        instance: 1,
        seeds: vec![1, 2],
        candidates: 1,
        progress_milliseconds: 100,
    }
}

/// A snapshot for Hopper with these tensors.
pub fn snapshot(tensors: Vec<u8>) -> Snapshot {
    let schema =
        Schema { environment: "hopper".to_owned(), observation_dim: 11, action_dim: 3, policy: "diffusion".to_owned() };
    Snapshot { run: job().run, incarnation: 1, step: 1, schema, hash: Hash::of(&tensors), tensors }
}

/// A diffusion policy for Hopper of the smallest size.
pub const SMALLEST: DiffusionShape =
    DiffusionShape { observation_dim: 11, action_dim: 3, hidden: 1, critics: 1, diffusion_steps: 1 };

/// The tensors of a diffusion policy, all zero.
pub fn tensors(shape: DiffusionShape) -> Vec<u8> {
    let zeros = |layout: Layout| {
        let values = Tensor::zeros(layout.count(), DType::F32, &Device::Cpu).unwrap();
        Weights::constant(layout, values)
    };
    let actor = NoisePredictor::new(shape.actor(), zeros(shape.actor().layout()), Precision::F32);
    let critics = Ensemble::new(shape.critics(), zeros(shape.critics().layout()), Precision::F32);
    let tensors = DiffusionPolicy::tensors(&actor, &critics).unwrap();
    Description::Diffusion(shape).to_safetensors(&tensors).unwrap()
}
