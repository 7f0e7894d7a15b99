//! Data for the tests of this module and the tools.

use std::sync::Arc;
use std::time::Duration;

use candle_core::{DType, Device, Tensor};
use quad_nn::Layout;
use quad_policy::{Choice, DiffusionShape, Header, MlpConfig, PolicyConfig, Precision};
use quad_protocol::{Hash, Job, Name, Origin, Snapshot};
use quad_runtime::Health;

use super::evaluate::Evaluator;
use crate::metrics::Metrics;
use crate::sim::Simulations;

/// Two episodes of Hopper.
pub fn job() -> Job {
    Job {
        id: 1,
        run: Name::new("run").unwrap(),
        incarnation: 1,
        step: 1,
        weights: Hash::new(b""),
        environment: "hopper".to_owned(),
        environment_seed: 1,
        seeds: vec![1, 2],
        exploration: None,
        progress_milliseconds: 100,
    }
}

pub fn snapshot(file: Vec<u8>) -> Snapshot {
    Snapshot { run: job().run, incarnation: 1, step: 1, hash: Hash::new(&file), file }
}

/// A diffusion policy for Hopper of the smallest size.
pub fn smallest() -> DiffusionShape {
    DiffusionShape::quad((11, 3), &MlpConfig::mish(&[1]), 1, 1)
}

/// The file of a diffusion policy, all zero, that takes the best of `candidates`.
pub fn file(environment: &str, shape: DiffusionShape, candidates: u32) -> Vec<u8> {
    let choice = Choice::best_of(candidates);
    let policy = PolicyConfig::Diffusion { shape, choice };
    let zeros = |layout: &Layout| Tensor::zeros(layout.count(), DType::F32, &Device::Cpu);
    let tensors = policy.tensors(zeros).unwrap();
    let origin = Origin { environment: environment.to_owned(), seed: 1, step: 1, episodes: 2 };
    let header = Header::new(policy, origin);
    header.to_safetensors(&tensors).unwrap()
}

/// An evaluator that is stuck without progress for `limit`.
pub fn evaluator(health: &Health, limit: Duration) -> Evaluator {
    Evaluator {
        name: Name::new("evaluator").unwrap(),
        environments: Arc::new(Simulations),
        precision: Precision::F32,
        metrics: Metrics::new().unwrap(),
        policy: None,
        beat: health.register("worker", limit),
    }
}
