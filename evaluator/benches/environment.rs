//! Hopper's control periods a second, one thread, actions uniform at random.
#![allow(clippy::expect_used, missing_docs)]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use quad_dataset::environment::find;
use quad_evaluator::environment::make;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn hopper(criterion: &mut Criterion) {
    let mut environment =
        make(find("hopper").expect("a known environment")).expect("MuJoCo compiles the embedded model");
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let mut seed = 0;
    environment.reset(seed);
    let mut group = criterion.benchmark_group("environment");
    group.throughput(Throughput::Elements(1));
    group.bench_function("hopper", |bencher| {
        bencher.iter(|| {
            let step = environment.step(&random.random::<[f32; 3]>().map(|unit| 2.0 * unit - 1.0));
            if step.terminated || step.truncated {
                seed += 1;
                environment.reset(seed);
            }
        });
    });
    group.finish();
}

criterion_group!(benches, hopper);
criterion_main!(benches);
