//! Data for the tests of this module.

use candle_core::{DType, Device, Tensor};
use quad_policy::{Choice, DiffusionShape, Header, MlpConfig, PolicyConfig};
use quad_protocol::{Hash, Job, Name, Origin, Snapshot};

/// Two episodes of Hopper.
pub fn job() -> Job {
    Job {
        id: 1,
        run: Name::new("run").unwrap(),
        incarnation: 1,
        step: 1,
        weights: Hash::of(b""),
        environment: "hopper".to_owned(),
        environment_seed: 1,
        seeds: vec![1, 2],
        progress_milliseconds: 100,
    }
}

/// A snapshot with this file.
pub fn snapshot(file: Vec<u8>) -> Snapshot {
    Snapshot { run: job().run, incarnation: 1, step: 1, hash: Hash::of(&file), file }
}

/// A diffusion policy for Hopper of the smallest size.
pub fn smallest() -> DiffusionShape {
    DiffusionShape::quad((11, 3), &MlpConfig::mish(&[1]), 1, 1)
}

/// The file of a diffusion policy for an environment, all zero, that takes the best of
/// `candidates`.
pub fn file(environment: &str, shape: DiffusionShape, candidates: u32) -> Vec<u8> {
    let policy = PolicyConfig::Diffusion { shape, choice: Choice::best_of(candidates) };
    let tensors =
        policy.tensors(|layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu)).unwrap();
    let origin = Origin { environment: environment.to_owned(), seed: 1, step: 1, episodes: 2 };
    Header::new(policy, origin).to_safetensors(&tensors).unwrap()
}
