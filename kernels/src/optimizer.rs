//! Adam (Kingma and Ba 2015) and EMA over flat parameter vectors, in parallel.

use rayon::prelude::*;

use crate::vectorized::vectorized;

/// Numbers of one task: a few arrays of them fit into a core's own cache.
const CHUNK: usize = 1 << 14;

/// Adam's decay rate of the first moment, β1.
pub const BETA1: f64 = 0.9;
/// Adam's decay rate of the second moment, β2.
pub const BETA2: f64 = 0.999;
/// Number ε that Adam adds to the root of the second moment.
pub const EPSILON: f32 = 1e-8;

vectorized! {
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
}

/// Coefficients of one step of Adam.
#[derive(Clone, Copy, Debug)]
pub struct AdamRates {
    /// Learning rate over the first moment's bias correction.
    pub rate: f32,
    /// Weight decay times learning rate.
    pub decay: f32,
    /// 1/sqrt of the second moment's bias correction.
    pub correction: f32,
}

impl AdamRates {
    /// The coefficients of step number `count`, from 1.
    pub fn new(rate: f32, decay: f32, count: u64) -> Self {
        let count = count as f64;
        Self {
            rate: (f64::from(rate) / (1.0 - BETA1.powf(count))) as f32,
            decay: rate * decay,
            correction: (1.0 / (1.0 - BETA2.powf(count)).sqrt()) as f32,
        }
    }
}

vectorized! {
    fn adam_chunk(scale: f32, rates: AdamRates, parameters: &mut [f32], first: &mut [f32], second: &mut [f32], gradient: &[f32]) {
        // Rounded from f64, since 1 − 0.999 in f32 has an error of 5e-5.
        const NEW: [f32; 2] = [(1.0 - BETA1) as f32, (1.0 - BETA2) as f32];
        const OLD: [f32; 2] = [BETA1 as f32, BETA2 as f32];
        for (((p, m), v), g) in parameters.iter_mut().zip(first).zip(second).zip(gradient) {
            let g = g * scale;
            *m = OLD[0] * *m + NEW[0] * g;
            *v = OLD[1] * *v + NEW[1] * g * g;
            // One subtraction: the decay alone would be rounded away.
            *p -= rates.rate * *m / (v.sqrt() * rates.correction + EPSILON) + rates.decay * *p;
        }
    }
}

vectorized! {
    fn ema_chunk(target: &mut [f32], online: &[f32], rate: f32) {
        for (target, online) in target.iter_mut().zip(online) {
            *target += rate * (online - *target);
        }
    }
}

/// The Euclidean norm. The order of the sum does not depend on the number of threads.
pub fn norm(x: &[f32]) -> f32 {
    let squares: Vec<f32> = x.par_chunks(CHUNK).map(sum_of_squares).collect();
    squares.iter().map(|x| f64::from(*x)).sum::<f64>().sqrt() as f32
}

/// Adam's step number `count` along the gradient g = `scale`·`gradient`:
///
/// m = β1·m + (1 − β1)·g, v = β2·v + (1 − β2)·g²,
/// p = p − rate·m/(1 − β1^count) / (√(v/(1 − β2^count)) + ε) − rate·decay·p.
pub fn adam(
    parameters: &mut [f32],
    (first, second): (&mut [f32], &mut [f32]),
    gradient: &[f32],
    scale: f32,
    rates: AdamRates,
) {
    parameters
        .par_chunks_mut(CHUNK)
        .zip(first.par_chunks_mut(CHUNK))
        .zip(second.par_chunks_mut(CHUNK))
        .zip(gradient.par_chunks(CHUNK))
        .for_each(|(((p, m), v), g)| adam_chunk(scale, rates, p, m, v, g));
}

/// `target = (1 - rate)·target + rate·online`.
pub fn ema(target: &mut [f32], online: &[f32], rate: f32) {
    target
        .par_chunks_mut(CHUNK)
        .zip(online.par_chunks(CHUNK))
        .for_each(|(target, online)| ema_chunk(target, online, rate));
}
