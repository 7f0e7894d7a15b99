//! Our kernels beside what a library does, at the shapes of a gradient step and on one thread. A
//! library's line stands next to ours and is timed within the same second or two: compare
//! neighbors, the machine may be shared. The rates are GFLOP/s of products (criterion calls them
//! Gelem/s) and G elements/s of activations.

#![allow(missing_docs)] // criterion's macros define public functions without any

use criterion::measurement::WallTime;
use criterion::{
    BenchmarkGroup, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main,
};
use quad_kernels::Buffer;
use quad_kernels::Precision::{Bf16, F32};
use quad_kernels::activation::Activation::Mish;
use quad_kernels::activation::{activate, activate_with_slope};
use quad_kernels::product::{Matrix, Packed, by_gemm, outer, product, product_transposed};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::time::Duration;

/// Right-hand sides that take turns: the hidden layers of ten critics, which come from a cache that
/// cores share. So do the results of outer products, the gradients of as many layers.
const IN_TURN: usize = 20;

/// `len` numbers from a cache line on, as the networks keep them.
fn numbers(len: usize, seed: usize) -> Buffer {
    let mut generator = ChaCha8Rng::seed_from_u64(seed as u64);
    let mut buffer = Buffer::default();
    buffer.sized(len).fill_with(|| generator.random_range(-1.0..1.0));
    buffer
}

fn zeros(len: usize) -> Buffer {
    let mut buffer = Buffer::default();
    buffer.sized(len).fill(0.0);
    buffer
}

fn group<'a>(
    criterion: &'a mut Criterion,
    name: &str,
    elements: usize,
) -> BenchmarkGroup<'a, WallTime> {
    let mut group = criterion.benchmark_group(name);
    group
        .sample_size(20)
        .warm_up_time(Duration::from_millis(200))
        .measurement_time(Duration::from_millis(800));
    group.throughput(Throughput::Elements(elements as u64));
    group
}

/// A product to be timed, with the right-hand side of a number: left side, right side, result.
type Product<'a> = &'a dyn Fn(usize, &[f32], &[f32], &mut [f32]);

/// Memory order of an operand.
type Side = for<'a> fn(&'a [f32]) -> Matrix<'a>;
const AS_IT_IS: Side = |elements| Matrix::RowMajor(elements);
const TRANSPOSED: Side = |elements| Matrix::TransposeOf(elements);

/// One of our products beside gemm's.
fn compare(
    criterion: &mut Criterion,
    (name, [m, k, n]): (&str, [usize; 3]),
    (left_side, right_side, outs): (Side, Side, usize),
    ours: Product<'_>,
) {
    let mut group = group(criterion, name, 2 * m * k * n);
    let left = numbers(m * k, 0);
    let a = left.first(m * k);
    let right: Vec<_> = (1..=IN_TURN).map(|seed| numbers(k * n, seed)).collect();
    let mut outs: Vec<_> = (0..outs).map(|_| zeros(m * n)).collect();
    let count = outs.len();
    let by_gemm = |_, a: &[f32], b: &[f32], out: &mut [f32]| {
        by_gemm([m, k, n], left_side(a), right_side(b), out)
    };
    let both: [(&str, Product<'_>); 2] = [("ours", ours), ("gemm", &by_gemm)];
    for (sides, (name, work)) in
        [1, IN_TURN].into_iter().flat_map(|sides| both.map(|one| (sides, one)))
    {
        let mut turn = 0;
        group.bench_function(BenchmarkId::new(name, format!("{sides} in turn")), |bencher| {
            bencher.iter(|| {
                turn = (turn + 1) % sides;
                work(turn, a, right[turn].first(k * n), outs[turn % count].sized(m * n));
            });
        });
    }
    group.finish();
}

/// A layer's forward pass, the gradient that it passes on, and that of its weights: the hidden
/// layers of the paper's networks and of the demonstration's, and the first layer, which is never
/// rounded. The library has no product of rounded factors and multiplies in f32.
fn products(criterion: &mut Criterion) {
    for precision in [F32, Bf16].into_iter().filter(|precision| precision.is_available()) {
        let named = |name: String| format!("{name}, {}", precision.name());
        for [m, k, n] in [[128, 256, 256], [128, 128, 128], [128, 11, 256]] {
            let (name, orders) = (format!("product, {m} × {k} × {n}"), (AS_IT_IS, AS_IT_IS, 1));
            compare(criterion, (&named(name), [m, k, n]), orders, &|_, x, weights, out| {
                product(precision, x, weights, out, k, n)
            });
        }
        for [m, k, n] in [[128, 256, 256], [128, 128, 128]] {
            let name = format!("product with the transpose, {m} × {n} × {k}");
            let orders = (AS_IT_IS, TRANSPOSED, 1);
            compare(criterion, (&named(name), [m, n, k]), orders, &|_, g, weights, out| {
                product_transposed(precision, g, weights, out, k, n)
            });
        }
        for [m, k, n] in [[128, 256, 256], [256, 256, 256], [128, 128, 128]] {
            let name = format!("outer product of {m} rows, {k} × {n}");
            let orders = (TRANSPOSED, AS_IT_IS, IN_TURN);
            compare(criterion, (&named(name), [k, m, n]), orders, &|_, x, g, out| {
                outer(precision, x, g, out, k, n)
            });
        }
        // As a policy acts: for ten episodes on one thread, for ten candidates.
        for [m, k, n] in [[100, 256, 256], [10, 256, 256]] {
            let pack = |seed| Packed::new(precision, numbers(k * n, seed).first(k * n), k, n);
            let Some(packed) = (1..=IN_TURN).map(pack).collect::<Option<Vec<_>>>() else { return };
            let name = format!("packed product, {m} × {k} × {n}");
            let orders = (AS_IT_IS, AS_IT_IS, 1);
            compare(criterion, (&named(name), [m, k, n]), orders, &|i, x, _, out| {
                packed[i].product(x, out)
            });
        }
    }
}

/// Mish as one writes it with the standard library, but with one exponential.
fn mish_by_std(x: &mut [f32]) {
    for x in x {
        let e = x.min(20.0).exp();
        let n = e * (e + 2.0);
        *x *= n / (n + 2.0);
    }
}

/// Those that work in place are given the same numbers again by a copy, which is measured with
/// them: Mish of Mish of … ends at numbers that CPUs are slow with.
fn activations(criterion: &mut Criterion) {
    let (rows, width) = (128, 256);
    let len = rows * width;
    let mut group = group(criterion, &format!("activation, {rows} × {width}"), len);
    let (x, bias, mut y, mut slope) = (numbers(len, 0), numbers(width, 1), zeros(len), zeros(len));
    let (x, bias, y, slope) = (x.first(len), bias.first(width), y.sized(len), slope.sized(len));
    let mut bench = |name: &str, work: &mut dyn FnMut(&mut [f32])| {
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                y.copy_from_slice(x);
                work(y);
            });
        });
    };
    bench("copy", &mut |_| ());
    bench("mish by std's exp", &mut mish_by_std);
    bench("mish", &mut |y| activate(Mish, y, bias));
    bench("mish_slope", &mut |y| activate_with_slope(Mish, y, bias, slope));
    group.finish();
}

criterion_group!(benches, products, activations);
criterion_main!(benches);
