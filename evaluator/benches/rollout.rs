//! Ten Hopper episodes at the paper's sizes: a step of all, and its parts. A step of each
//! environment.

#![allow(clippy::expect_used)]

use std::hint::black_box;

use candle_core::Device;
use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use quad_dataset::environment;
use quad_evaluator::sim::{EnvironmentError, Environments, Rollout, Simulations, make};
use quad_nn::{Layout, Weights};
use quad_policy::{
    Choice, DiffusionShape, EpisodeState, Header, MlpConfig, Policy, PolicyConfig, Precision,
    load_policy,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const EPISODES: usize = 10;
const CANDIDATES: u32 = 10;
/// Few enough that no episode ends.
const STEPS: usize = 4;

/// Policies of the paper's shape with random weights, in each precision that this CPU has.
fn policies() -> impl Iterator<Item = (&'static str, Box<dyn Policy>)> {
    let shape = DiffusionShape::quad((11, 3), &MlpConfig::mish(&[256; 3]), 10, 5);
    let mut generator = ChaCha8Rng::seed_from_u64(0);
    let choice = Choice::best_of(CANDIDATES);
    let policy = PolicyConfig::Diffusion { shape, choice };
    let initial = |layout: &Layout| Weights::initial(layout, &mut generator, &Device::Cpu);
    let tensors = policy.tensors(initial).expect("weights");
    let file = Header::new(policy, ()).to_safetensors(&tensors).expect("finite weights");
    let precisions = [Precision::F32, Precision::Bf16].into_iter();
    let available = precisions.filter(|precision| precision.is_available());
    available.map(move |precision| {
        let policy = load_policy(&file, precision).expect("a policy's file");
        (precision.name(), policy)
    })
}

/// A few steps of ten episodes, each a policy call and a control period.
fn steps(criterion: &mut Criterion) {
    let seeds: Vec<u64> = (0..EPISODES as u64).collect();
    let mut group = criterion.benchmark_group("rollout");
    for (precision, policy) in policies() {
        let begin = || {
            let make = || Simulations.make("hopper", 0);
            let rollout = Rollout::new(make, (11, 3), &seeds, |seed| policy.begin(seed));
            rollout.expect("MuJoCo compiles the embedded model")
        };
        let act = |observations: &[f32], states: &mut [EpisodeState], actions: &mut [f32]| {
            policy.act(observations, states, actions).expect("finite actions");
            Ok::<_, EnvironmentError>(())
        };
        let run = |rollout: &mut Rollout<EpisodeState>| {
            rayon::scope(|_| {
                for _ in 0..STEPS {
                    let stepped = rollout.step(act).expect("a simulation cannot fail");
                    assert_eq!(stepped.steps, EPISODES as u64, "an episode has ended");
                }
            });
        };
        group.bench_function(format!("{STEPS} steps, {precision}"), |bencher| {
            bencher.iter_batched_ref(begin, run, BatchSize::PerIteration);
        });
    }
    group.finish();
}

/// The policy alone, for ten states.
fn select(criterion: &mut Criterion) {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let observations: Vec<f32> =
        (0..EPISODES * 11).map(|_| random.random_range(-1.0..1.0)).collect();
    let mut actions = vec![0.0; EPISODES * 3];
    let mut group = criterion.benchmark_group("select");
    for (precision, policy) in policies() {
        let mut states: Vec<_> = (0..EPISODES as u64).map(|seed| policy.begin(seed)).collect();
        group.bench_function(precision, |bencher| {
            bencher.iter(|| rayon::scope(|_| policy.act(&observations, &mut states, &mut actions)));
            black_box(&actions);
        });
    }
    group.finish();
}

/// Control periods of one environment on one thread, with uniform random actions.
fn environments(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("environment");
    // Environments of one simulation differ in the goal alone.
    for spec in environment::specs().iter().filter(|spec| spec.name == spec.simulation()) {
        let mut environment = make(spec, 0).expect("MuJoCo compiles the embedded model");
        let mut random = ChaCha8Rng::seed_from_u64(0);
        let mut action = vec![0.0; spec.action_dim];
        let mut seed = 0;
        environment.reset(seed);
        group.bench_function(&spec.name, |bencher| {
            bencher.iter(|| {
                action.fill_with(|| random.random_range(-1.0..1.0));
                let step = environment.step(&action);
                if step.terminated || step.truncated {
                    seed += 1;
                    environment.reset(seed);
                }
            });
        });
    }
    group.finish();
}

criterion_group!(benches, steps, select, environments);
criterion_main!(benches);
