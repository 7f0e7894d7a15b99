//! Ten Hopper episodes at the paper's sizes: a step of all of them together, and what it is made
//! of. And a step of each environment.

#![allow(clippy::expect_used)] // what cannot be had ends the run

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
use std::hint::black_box;

const EPISODES: usize = 10;
const CANDIDATES: u32 = 10;
/// Steps from the episodes' beginning, few enough that none falls over.
const STEPS: usize = 4;

/// What this CPU computes in.
fn precisions() -> impl Iterator<Item = Precision> {
    [Precision::F32, Precision::Bf16].into_iter().filter(|precision| precision.is_available())
}

/// A policy of the paper's shape with random weights, as an evaluator gets it.
fn policy(precision: Precision) -> Box<dyn Policy> {
    let shape = DiffusionShape::quad((11, 3), &MlpConfig::mish(&[256; 3]), 10, 5);
    let mut generator = ChaCha8Rng::seed_from_u64(0);
    let policy = PolicyConfig::Diffusion { shape, choice: Choice::best_of(CANDIDATES) };
    let initial = |layout: &Layout| Weights::initial(layout, &mut generator, &Device::Cpu);
    let tensors = policy.tensors(initial).expect("weights");
    let file = Header::new(policy, ()).to_safetensors(&tensors).expect("finite weights");
    load_policy(&file, precision).expect("what was just written")
}

/// Four steps of ten episodes; a policy call and a control period each.
fn steps(criterion: &mut Criterion) {
    let seeds: Vec<u64> = (0..EPISODES as u64).collect();
    let mut group = criterion.benchmark_group("rollout");
    for precision in precisions() {
        let policy = policy(precision);
        group.bench_function(format!("{STEPS} steps, {}", precision.name()), |bencher| {
            bencher.iter_batched_ref(
                || {
                    Rollout::new(
                        || Simulations.make("hopper", 0),
                        (11, 3),
                        &seeds,
                        |seed| policy.begin(seed),
                    )
                    .expect("MuJoCo compiles the embedded model")
                },
                |rollout| {
                    rayon::scope(|_| {
                        for _ in 0..STEPS {
                            let act = |observations: &[f32],
                                       states: &mut [EpisodeState],
                                       actions: &mut [f32]| {
                                policy
                                    .act(observations, states, actions)
                                    .expect("the policy's numbers are finite");
                                Ok::<_, EnvironmentError>(())
                            };
                            rollout.step(act).expect("a simulation cannot break down");
                        }
                    });
                    assert_eq!(
                        rollout.environment_steps(),
                        (EPISODES * STEPS) as u64,
                        "an episode has ended"
                    );
                },
                BatchSize::PerIteration,
            );
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
    for precision in precisions() {
        let policy = policy(precision);
        let mut states: Vec<EpisodeState> =
            (0..EPISODES as u64).map(|seed| policy.begin(seed)).collect();
        group.bench_function(precision.name(), |bencher| {
            bencher.iter(|| rayon::scope(|_| policy.act(&observations, &mut states, &mut actions)));
            black_box(&actions);
        });
    }
    group.finish();
}

/// Control periods of one environment on one thread, actions uniform at random.
fn environments(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("environment");
    // Those of one simulation differ in the goal alone.
    for spec in environment::all().iter().filter(|spec| spec.name == spec.simulation()) {
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
