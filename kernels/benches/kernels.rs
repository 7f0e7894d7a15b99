//! Our kernels beside what a library does, at the shapes of a gradient step and on one thread. A library's line stands
//! next to ours and is timed within the same second or two: compare neighbours, the machine may be shared.
//! The rates are GFLOP/s of products (criterion calls them Gelem/s) and G elements/s of activations.

#![allow(missing_docs)] // criterion's macros define public functions without any

use criterion::measurement::WallTime;
use criterion::{BenchmarkGroup, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use gemm::{Parallelism, gemm};
use quad_kernels::Buffer;
use quad_kernels::activation::Activation::Mish;
use quad_kernels::activation::{activate, activate_with_slope};
use quad_kernels::product::{Rounded, outer, product, product_transposed};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::time::Duration;

/// Right-hand sides that take turns: the hidden layers of ten critics, which come from a cache that cores share.
const IN_TURN: usize = 20;

/// Rows, inner size and columns of a product.
#[derive(Clone, Copy)]
struct Shape {
    m: usize,
    k: usize,
    n: usize,
}

impl Shape {
    fn operations(self) -> u64 {
        2 * (self.m * self.k * self.n) as u64
    }
}

/// A matrix and its transpose have the same elements at other distances.
#[derive(Clone, Copy)]
enum Order {
    RowMajor,
    Transposed,
}

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

/// `out[m × n] = a[m × k] · b[k × n]`, where either may be stored as its transpose.
fn by_gemm(Shape { m, k, n }: Shape, a: (&[f32], Order), b: (&[f32], Order), out: &mut [f32]) {
    assert!(a.0.len() == m * k && b.0.len() == k * n && out.len() == m * n, "the product's shape");
    /// Distances between columns and between rows.
    fn strides(order: Order, rows: usize, columns: usize) -> (isize, isize) {
        match order {
            Order::RowMajor => (1, columns as isize),
            Order::Transposed => (rows as isize, 1),
        }
    }
    let (a_strides, b_strides) = (strides(a.1, m, k), strides(b.1, k, n));
    let (no, one) = (false, Parallelism::None);
    // SAFETY: the three slices are of these shapes, and `out` is borrowed exclusively.
    unsafe {
        let (a, b, out) = (a.0.as_ptr(), b.0.as_ptr(), out.as_mut_ptr());
        let ((a_column, a_row), (b_column, b_row)) = (a_strides, b_strides);
        gemm(m, n, k, out, 1, n as isize, no, a, a_column, a_row, b, b_column, b_row, 0.0, 1.0, no, no, no, one);
    }
}

fn group<'a>(criterion: &'a mut Criterion, name: String, elements: u64) -> BenchmarkGroup<'a, WallTime> {
    let mut group = criterion.benchmark_group(name);
    group.sample_size(20).warm_up_time(Duration::from_millis(200)).measurement_time(Duration::from_millis(800));
    group.throughput(Throughput::Elements(elements));
    group
}

/// Benchmarks `work` with one right-hand side and with [`IN_TURN`]; it is given the number of the one to take.
fn bench(group: &mut BenchmarkGroup<'_, WallTime>, name: &str, sides: usize, mut work: impl FnMut(usize)) {
    let mut turn = 0;
    group.bench_function(BenchmarkId::new(name, format!("{sides} in turn")), |bencher| {
        bencher.iter(|| {
            turn = (turn + 1) % sides;
            work(turn);
        });
    });
}

/// The two layers of the paper's networks, of the demonstration's, and the first.
fn products(criterion: &mut Criterion) {
    for (m, k, n) in [(128, 256, 256), (128, 128, 128), (128, 11, 256)] {
        let shape = Shape { m, k, n };
        let mut group = group(criterion, format!("product, {m} × {k} × {n}"), shape.operations());
        let (x, mut out) = (numbers(m * k, 0), zeros(m * n));
        let (x, out) = (x.first(m * k), out.sized(m * n));
        let weights: Vec<_> = (1..=IN_TURN).map(|seed| numbers(k * n, seed)).collect();
        for sides in [1, IN_TURN] {
            bench(&mut group, "ours", sides, |i| product(x, weights[i].first(k * n), out, k, n));
            bench(&mut group, "gemm", sides, |i| {
                by_gemm(shape, (x, Order::RowMajor), (weights[i].first(k * n), Order::RowMajor), out);
            });
        }
        group.finish();
    }
}

/// The backward pass through a layer.
fn transposed(criterion: &mut Criterion) {
    for (m, k, n) in [(128, 256, 256), (128, 128, 128)] {
        let shape = Shape { m, k: n, n: k };
        let mut group = group(criterion, format!("product with the transpose, {m} × {n} × {k}"), shape.operations());
        let (g, mut out) = (numbers(m * n, 0), zeros(m * k));
        let (g, out) = (g.first(m * n), out.sized(m * k));
        let weights: Vec<_> = (1..=IN_TURN).map(|seed| numbers(k * n, seed)).collect();
        for sides in [1, IN_TURN] {
            bench(&mut group, "ours", sides, |i| product_transposed(g, weights[i].first(k * n), out, k, n));
            bench(&mut group, "gemm", sides, |i| {
                by_gemm(shape, (g, Order::RowMajor), (weights[i].first(k * n), Order::Transposed), out);
            });
        }
        group.finish();
    }
}

/// The gradient of a layer's weights: there, each result has a place of its own, too.
fn outers(criterion: &mut Criterion) {
    for (m, k, n) in [(128, 256, 256), (256, 256, 256), (128, 128, 128)] {
        let shape = Shape { m: k, k: m, n };
        let mut group = group(criterion, format!("outer product of {m} rows, {k} × {n}"), shape.operations());
        let x = numbers(m * k, 0);
        let x = x.first(m * k);
        let gradients: Vec<_> = (1..=IN_TURN).map(|seed| numbers(m * n, seed)).collect();
        let mut outs: Vec<_> = (0..IN_TURN).map(|_| zeros(k * n)).collect();
        for sides in [1, IN_TURN] {
            bench(&mut group, "ours", sides, |i| {
                outer(x, gradients[i].first(m * n), outs[i].sized(k * n), k, n);
            });
            bench(&mut group, "gemm", sides, |i| {
                let (x, g) = ((x, Order::Transposed), (gradients[i].first(m * n), Order::RowMajor));
                by_gemm(shape, x, g, outs[i].sized(k * n));
            });
        }
        group.finish();
    }
}

/// The product of rounded operands, the right one rounded before; the library has none and multiplies in f32. Nothing
/// is measured on a CPU that gains nothing by it.
fn rounded(criterion: &mut Criterion) {
    for (m, k, n) in [(32, 256, 256), (32, 128, 128)] {
        let shape = Shape { m, k, n };
        let (x, mut out) = (numbers(m * k, 0), zeros(m * n));
        let (x, out) = (x.first(m * k), out.sized(m * n));
        let weights: Vec<_> = (1..=IN_TURN).map(|seed| numbers(k * n, seed)).collect();
        let rounded: Option<Vec<_>> = weights.iter().map(|w| Rounded::new(w.first(k * n), k, n)).collect();
        let Some(rounded) = rounded else { return };
        let mut group = group(criterion, format!("bf16 product, {m} × {k} × {n}"), shape.operations());
        for sides in [1, IN_TURN] {
            bench(&mut group, "ours", sides, |i| rounded[i].product(x, out));
            bench(&mut group, "ours in f32", sides, |i| product(x, weights[i].first(k * n), out, k, n));
            bench(&mut group, "gemm in f32", sides, |i| {
                by_gemm(shape, (x, Order::RowMajor), (weights[i].first(k * n), Order::RowMajor), out);
            });
        }
        group.finish();
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

/// Those that work in place are given the same numbers again by a copy, which is measured with them: Mish of Mish of …
/// ends at numbers that CPUs are slow with.
fn activations(criterion: &mut Criterion) {
    let (rows, width) = (128, 256);
    let len = rows * width;
    let mut group = group(criterion, format!("activation, {rows} × {width}"), len as u64);
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

criterion_group!(benches, products, transposed, outers, rounded, activations);
criterion_main!(benches);
