//! Adam (Kingma and Ba 2015) with clipping by the global norm, and EMA, over flat parameter vectors.

use multiversion::multiversion;
use rayon::prelude::*;

/// Numbers per task: a few arrays of them fit into a core's own cache.
const CHUNK: usize = 1 << 14;
const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-8;

/// First and second moments of the gradient.
#[derive(Clone, Debug, PartialEq)]
pub struct Moments {
    /// Running mean m.
    pub first: Vec<f32>,
    /// Running mean of squares v.
    pub second: Vec<f32>,
}

impl Moments {
    /// All zero.
    pub fn zeros(len: usize) -> Self {
        Self { first: vec![0.0; len], second: vec![0.0; len] }
    }
}

/// One optimiser step's numbers.
#[derive(Clone, Copy, Debug)]
pub struct AdamStep {
    /// Step size, before the moments' bias corrections.
    pub learning_rate: f32,
    /// Global norm above which the gradient is scaled down to it.
    pub clip: f32,
    /// 1 for the first.
    pub count: u64,
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma", "x86_64+avx2+fma"))]
fn add(sum: &mut [f32], other: &[f32]) {
    for (sum, x) in sum.iter_mut().zip(other) {
        *sum += x;
    }
}

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

/// Coefficients of Adam's element-wise update.
struct Update {
    /// Of the gradient: the clip's scale.
    scale: f32,
    /// Learning rate over the first moment's bias correction.
    rate: f32,
    /// 1/sqrt of the second moment's bias correction.
    correction: f32,
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma", "x86_64+avx2+fma"))]
fn adam_chunk(update: &Update, parameters: &mut [f32], m: &mut [f32], v: &mut [f32], gradient: &[f32]) {
    for (((p, m), v), g) in parameters.iter_mut().zip(m).zip(v).zip(gradient) {
        let g = g * update.scale;
        *m = BETA1 * *m + (1.0 - BETA1) * g;
        *v = BETA2 * *v + (1.0 - BETA2) * g * g;
        *p -= update.rate * *m / (v.sqrt() * update.correction + EPSILON);
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma", "x86_64+avx2+fma"))]
fn ema_chunk(target: &mut [f32], online: &[f32], rate: f32) {
    for (target, online) in target.iter_mut().zip(online) {
        *target += rate * (online - *target);
    }
}

/// Sums the gradient's copies (one per tile) into the first, and returns its global norm.
pub fn reduce(gradient: &mut [f32], len: usize) -> f32 {
    let (sum, others) = gradient.split_at_mut(len);
    let others = &*others;
    let squares: Vec<f32> = sum
        .par_chunks_mut(CHUNK)
        .enumerate()
        .map(|(i, sum)| {
            for other in others.chunks_exact(len) {
                add(sum, &other[i * CHUNK..][..sum.len()]);
            }
            sum_of_squares(sum)
        })
        .collect();
    squares.iter().map(|x| f64::from(*x)).sum::<f64>().sqrt() as f32
}

/// Clips the gradient, whose norm is known, and takes Adam's step.
pub fn adam(step: AdamStep, norm: f32, parameters: &mut [f32], moments: &mut Moments, gradient: &[f32]) {
    let count = step.count as f64;
    let update = Update {
        scale: (step.clip / norm).min(1.0),
        rate: (f64::from(step.learning_rate) / (1.0 - f64::from(BETA1).powf(count))) as f32,
        correction: (1.0 / (1.0 - f64::from(BETA2).powf(count)).sqrt()) as f32,
    };
    parameters
        .par_chunks_mut(CHUNK)
        .zip(moments.first.par_chunks_mut(CHUNK))
        .zip(moments.second.par_chunks_mut(CHUNK))
        .zip(gradient.par_chunks(CHUNK))
        .for_each(|(((p, m), v), g)| adam_chunk(&update, p, m, v, g));
}

/// `target = (1 - rate)·target + rate·online`.
pub fn ema(target: &mut [f32], online: &[f32], rate: f32) {
    target
        .par_chunks_mut(CHUNK)
        .zip(online.par_chunks(CHUNK))
        .for_each(|(target, online)| ema_chunk(target, online, rate));
}

/// Cosine decay from 1 at step 0 to 0 at `total`.
pub(super) fn cosine_decay(step: u64, total: u64) -> f32 {
    let progress = (step as f64 / total.max(1) as f64).min(1.0);
    (0.5 * (1.0 + (std::f64::consts::PI * progress).cos())) as f32
}
