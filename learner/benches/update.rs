//! Gradient steps at Hopper's shapes, whole and in parts, and the machine's peaks at these shapes, which bound them.
//! `deploy/bench.sh` makes a table of the results.

#![allow(clippy::expect_used)] // what cannot be had ends the run

use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, Criterion, criterion_group, criterion_main};
use gemm::{Parallelism, gemm};
use quad_dataset::Batch;
use quad_learner::agent::adam::{AdamStep, adam, ema, reduce};
use quad_learner::agent::{AgentConfig, EtaConfig, Guidance, Moments, TargetReduce};
use quad_learner::device::Device;
use quad_policy::{
    CriticEnsemble, NoisePredictor, NoisyActions, Parameters, Precision, StateActions, mish_in_place, mish_slope,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::time::Duration;

/// Hopper's observation and action.
const DIMS: (usize, usize) = (11, 3);

fn config(hidden: usize, critics: usize, samples: usize, threshold: Option<f32>, precision: Precision) -> AgentConfig {
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
        precision,
    }
}

/// The configurations that are measured, all but the precision; deploy/bench/bench.py knows their shapes.
fn configurations(precision: Precision) -> [(&'static str, AgentConfig); 3] {
    [
        ("paper, 10 samples", config(256, 10, 10, Some(1.0), precision)),
        ("paper, 1 sample", config(256, 10, 1, Some(1.0), precision)),
        ("demo", config(128, 5, 1, None, precision)),
    ]
}

fn numbers(len: usize) -> Vec<f32> {
    let mut generator = ChaCha8Rng::seed_from_u64(len as u64);
    (0..len).map(|_| generator.random_range(-1.0..1.0)).collect()
}

fn batch(size: usize) -> Batch {
    Batch {
        observations: numbers(size * DIMS.0),
        actions: numbers(size * DIMS.1),
        rewards: numbers(size),
        next_observations: numbers(size * DIMS.0),
        masks: vec![1.0; size],
        size,
    }
}

fn updates(criterion: &mut Criterion) {
    let (cpu, f32) = (Device::Cpu, Precision::F32);
    let mut groups = vec![("update", cpu, f32), ("update, bf16", cpu, Precision::Bf16)];
    // An update ends with its numbers on the host, so that nothing of it is left for the GPU to do.
    if cfg!(feature = "cuda") {
        groups.push(("update on cuda", Device::Cuda, f32));
    }
    for (group, device, precision) in groups {
        let mut group = criterion.benchmark_group(group);
        group.sample_size(20);
        for (name, config) in configurations(precision) {
            let architecture = config.architecture(DIMS.0, DIMS.1);
            let mut agent =
                device.agent(architecture, &config, 1_000_000, 0).expect("a usable configuration and device");
            let batch = batch(config.batch_size);
            group.bench_function(name, |bencher| bencher.iter(|| agent.update(&batch).expect("a step")));
        }
        group.finish();
    }
}

/// All threads at once, each on a tile of its own: 128 rows through a layer of 256, 1,000 times; and as many of the
/// activations that follow.
fn peaks(criterion: &mut Criterion) {
    const REPEAT: usize = 1_000;
    let (rows, width) = (128, 256);
    let threads = 0..rayon::current_num_threads();
    let mut group = criterion.benchmark_group("peak");
    group.sample_size(10);
    let mut tiles: Vec<_> =
        threads.clone().map(|_| (numbers(rows * width), numbers(width * width), vec![0.0_f32; rows * width])).collect();
    let product = |(x, w, out): &mut (Vec<f32>, Vec<f32>, Vec<f32>)| {
        let (row, n) = (width as isize, width);
        for _ in 0..REPEAT {
            // SAFETY: `out` and `x` are rows × width, `w` is width × width, all row-major.
            unsafe {
                let (out, x, w) = (out.as_mut_ptr(), x.as_ptr(), w.as_ptr());
                let (no, one) = (false, Parallelism::None);
                gemm(rows, n, n, out, 1, row, no, x, 1, row, w, 1, row, 0.0, 1.0, no, no, no, one);
            }
        }
    };
    group.bench_function("product", |bencher| bencher.iter(|| tiles.par_iter_mut().for_each(product)));
    let mish = |(x, _, out): &mut (Vec<f32>, Vec<f32>, Vec<f32>)| {
        for _ in 0..REPEAT {
            out.copy_from_slice(x);
            mish_in_place(out);
        }
    };
    group.bench_function("mish", |bencher| bencher.iter(|| tiles.par_iter_mut().for_each(mish)));
    let slope = |(x, w, out): &mut (Vec<f32>, Vec<f32>, Vec<f32>)| {
        (0..REPEAT).for_each(|_| mish_slope(x, out, &mut w[..rows * width]));
    };
    group.bench_function("mish and slope", |bencher| bencher.iter(|| tiles.par_iter_mut().for_each(slope)));
    group.finish();
}

/// What an update consists of, in its order, each by itself.
fn parts(criterion: &mut Criterion) {
    for (name, config) in configurations(Precision::F32) {
        let mut group = criterion.benchmark_group(name);
        group.sample_size(20).measurement_time(Duration::from_secs(2)).warm_up_time(Duration::from_millis(500));
        parts_of(&mut group, &config);
        group.finish();
    }
}

/// Benchmarks `work` on a thread of the pool, as an update runs.
fn bench(group: &mut BenchmarkGroup<'_, WallTime>, name: &str, mut work: impl FnMut() + Send) {
    group.bench_function(name, |bencher| bencher.iter(|| rayon::scope(|_| work())));
}

fn parts_of(group: &mut BenchmarkGroup<'_, WallTime>, config: &AgentConfig) {
    let architecture = config.architecture(DIMS.0, DIMS.1);
    let mut weights = Parameters::initialise(&architecture, &mut ChaCha8Rng::seed_from_u64(0));
    let mut target = weights.clone();
    let (actor, critics) = (NoisePredictor::new(&architecture), CriticEnsemble::new(&architecture));
    let (b, a, samples) = (config.batch_size, DIMS.1, config.samples);
    let Batch { observations, actions, rewards, next_observations, .. } = batch(b);
    // As they are.
    let plain = (actor.round(&target.actor, Precision::F32), critics.round(&target.critics, Precision::F32));

    let (noise, mut sampled) = (numbers(config.diffusion_steps * b * samples * a), vec![0.0; b * samples * a]);
    let sample = |out: &mut [f32]| actor.sample(&target.actor, &plain.0, &next_observations, samples, &noise, out);
    bench(group, "sampled next actions", || sample(&mut sampled));
    let mut values = vec![0.0; config.critics * b * samples];
    let next = StateActions { observations: &next_observations, actions: &sampled, repeat: samples };
    bench(group, "target critics", || critics.values(&target.critics, &plain.1, next, &mut values));
    let len = critics.parameters();
    let mut gradient = vec![0.0; critics.gradient_tiles(b) * len];
    bench(group, "critic step", || {
        critics.regress(&weights.critics, &observations, &actions, &rewards, 1e-3, &mut gradient);
    });
    let mut moments = Moments::zeros(len);
    let step = AdamStep { learning_rate: 1e-9, clip: 1.0, count: 1 };
    bench(group, "critic optimiser", || {
        let norm = reduce(&mut gradient, len);
        adam(step, norm, &mut weights.critics, &mut moments, &gradient[..len]);
    });
    bench(group, "critic EMA", || ema(&mut target.critics, &weights.critics, 0.005));

    let data = StateActions { observations: &observations, actions: &actions, repeat: 1 };
    bench(group, "Q-gradients' scale", || {
        critics.values(&target.critics, &plain.1, data, &mut values[..config.critics * b])
    });
    let mut gradients = vec![0.0; config.critics * b * a];
    bench(group, "Q-gradients", || {
        critics.action_gradients(&target.critics, &observations, &actions, &mut gradients);
    });
    let t: Vec<usize> = (0..b).map(|i| i % config.diffusion_steps + 1).collect();
    let noisy = NoisyActions { observations: &observations, actions: &actions, t: &t };
    let (mut predicted, mut gradient) = (vec![0.0; b * a], vec![0.0; weights.actor.len()]);
    let mut moments = Moments::zeros(weights.actor.len());
    bench(group, "actor step", || {
        let recording = actor.record(&weights.actor, noisy, &mut predicted);
        actor.differentiate(&weights.actor, noisy, recording, &actions, &mut gradient);
        // Again for η, with the new weights.
        if config.eta.threshold.is_some() {
            actor.predict(&weights.actor, noisy, &mut predicted);
        }
    });
    bench(group, "actor optimiser and EMA", || {
        let norm = reduce(&mut gradient, weights.actor.len());
        adam(step, norm, &mut weights.actor, &mut moments, &gradient);
        ema(&mut target.actor, &weights.actor, 0.005);
    });
}

criterion_group!(benches, peaks, updates, parts);
criterion_main!(benches);
