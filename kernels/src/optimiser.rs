//! Adam (Kingma and Ba 2015) and EMA over flat parameter vectors, in parallel.

use multiversion::multiversion;
use rayon::prelude::*;

/// Numbers per task: a few arrays of them fit into a core's own cache.
const CHUNK: usize = 1 << 14;

/// Adam's decay rate of the first moment, β1.
pub const BETA1: f64 = 0.9;
/// Adam's decay rate of the second moment, β2.
pub const BETA2: f64 = 0.999;
/// What Adam adds to the root of the second moment, ε.
pub const EPSILON: f32 = 1e-8;

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma", "x86_64+avx2+fma"))]
fn sum_of_squares(x: &[f32]) -> f32 {
    let mut lanes = [0.0_f32; 16];
    let chunks = x.chunks_exact(16);
    let rest: f32 = chunks.remainder().iter().map(|x| x * x).sum();
    for x in chunks {
        for l in 0..16 {
            lanes[l] = x[l].mul_add(x[l], lanes[l]);
        }
    }
    lanes.iter().sum::<f32>() + rest
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma", "x86_64+avx2+fma"))]
fn decay_chunk(first: &mut [f32], second: &mut [f32], gradient: &[f32], scale: f32) {
    // Of the new gradient: rounded from f64, since 1 - 0.999 in f32 would be off by a part in 20,000.
    const NEW: [f32; 2] = [(1.0 - BETA1) as f32, (1.0 - BETA2) as f32];
    const OLD: [f32; 2] = [BETA1 as f32, BETA2 as f32];
    for ((m, v), g) in first.iter_mut().zip(second).zip(gradient) {
        let g = g * scale;
        *m = OLD[0] * *m + NEW[0] * g;
        *v = OLD[1] * *v + NEW[1] * g * g;
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma", "x86_64+avx2+fma"))]
fn descend_chunk(parameters: &mut [f32], first: &[f32], second: &[f32], rate: f32, correction: f32) {
    for ((p, m), v) in parameters.iter_mut().zip(first).zip(second) {
        *p -= rate * *m / (v.sqrt() * correction + EPSILON);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma", "x86_64+avx2+fma"))]
fn ema_chunk(target: &mut [f32], online: &[f32], rate: f32) {
    for (target, online) in target.iter_mut().zip(online) {
        *target += rate * (online - *target);
    }
}

/// The Euclidean norm. The order of the sum does not depend on the number of threads.
pub fn norm(x: &[f32]) -> f32 {
    let squares: Vec<f32> = x.par_chunks(CHUNK).map(sum_of_squares).collect();
    squares.iter().map(|x| f64::from(*x)).sum::<f64>().sqrt() as f32
}

/// Takes a gradient, times `scale`, into Adam's moments: m = β1·m + (1 - β1)·g, v = β2·v + (1 - β2)·g².
pub fn decay_moments(first: &mut [f32], second: &mut [f32], gradient: &[f32], scale: f32) {
    first
        .par_chunks_mut(CHUNK)
        .zip(second.par_chunks_mut(CHUNK))
        .zip(gradient.par_chunks(CHUNK))
        .for_each(|((m, v), g)| decay_chunk(m, v, g, scale));
}

/// Adam's step number `count`, from 1, along moments that have just taken in the gradient:
/// p -= rate · m/(1 - β1^count) / (√(v/(1 - β2^count)) + ε).
pub fn descend(parameters: &mut [f32], first: &[f32], second: &[f32], rate: f32, count: u64) {
    let count = count as f64;
    let rate = (f64::from(rate) / (1.0 - BETA1.powf(count))) as f32;
    let correction = (1.0 / (1.0 - BETA2.powf(count)).sqrt()) as f32;
    parameters
        .par_chunks_mut(CHUNK)
        .zip(first.par_chunks(CHUNK))
        .zip(second.par_chunks(CHUNK))
        .for_each(|((p, m), v)| descend_chunk(p, m, v, rate, correction));
}

/// `target = (1 - rate)·target + rate·online`.
pub fn ema(target: &mut [f32], online: &[f32], rate: f32) {
    target
        .par_chunks_mut(CHUNK)
        .zip(online.par_chunks(CHUNK))
        .for_each(|(target, online)| ema_chunk(target, online, rate));
}
