//! Gradient steps at Hopper's shapes: the paper's sizes with 10 and with 1 next action per state, and the demo's.

#![allow(clippy::expect_used)] // what cannot be had ends the run

use criterion::{Criterion, criterion_group, criterion_main};
use quad_dataset::Batch;
use quad_learner::agent::{Agent, AgentConfig, EtaConfig, Guidance, TargetReduce};
use quad_policy::Precision;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Hopper's observation and action.
const DIMS: (usize, usize) = (11, 3);

fn config(hidden: usize, critics: usize, samples: usize, threshold: Option<f32>) -> AgentConfig {
    AgentConfig {
        hidden,
        critics,
        diffusion_steps: 5,
        batch_size: 256,
        gamma: 0.99,
        rho: 1.0,
        guidance: Guidance::Quad,
        tau: 1.0,
        delta: 1e-8,
        samples,
        target_reduce: TargetReduce::Mean,
        eta: EtaConfig { initial: 1.0, threshold, rate: 0.001, minimum: 0.001, maximum: 100.0 },
        actor_learning_rate: 3e-4,
        critic_learning_rate: 3e-4,
        gradient_clip: 1.0,
        ema_rate: 0.005,
        nu_ema_rate: 0.005,
        actor_ema_every: 5,
        actor_ema_start: 0,
        precision: Precision::F32,
    }
}

fn batch(size: usize) -> Batch {
    let mut generator = ChaCha8Rng::seed_from_u64(0);
    let mut numbers = |n: usize| (0..n).map(|_| generator.random_range(-1.0..1.0)).collect::<Vec<f32>>();
    Batch {
        observations: numbers(size * DIMS.0),
        actions: numbers(size * DIMS.1),
        rewards: numbers(size),
        next_observations: numbers(size * DIMS.0),
        masks: vec![1.0; size],
        size,
    }
}

fn update(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("update");
    group.sample_size(10);
    for (name, config) in [
        ("paper, 10 samples", config(256, 10, 10, Some(1.0))),
        ("paper, 1 sample", config(256, 10, 1, Some(1.0))),
        ("demo", config(128, 5, 1, None)),
    ] {
        let architecture = config.architecture(DIMS.0, DIMS.1);
        let mut agent = Agent::new(architecture, &config, 1_000_000, 0).expect("a usable configuration");
        let batch = batch(config.batch_size);
        group.bench_function(name, |bencher| bencher.iter(|| agent.update(&batch).expect("a step")));
    }
    group.finish();
}

criterion_group!(benches, update);
criterion_main!(benches);
