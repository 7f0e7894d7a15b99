//! Metrics of λ and guidance over a batch, computed on the CPU.

use super::guidance::Guide;
use crate::algorithm::Measured;
use candle_core::Tensor;

/// Metrics of the mean λ over each fifth of the denoising steps.
const FIFTHS: [&str; 5] =
    ["lambda_fifth_1", "lambda_fifth_2", "lambda_fifth_3", "lambda_fifth_4", "lambda_fifth_5"];

/// The tensors from which [`measure`] computes: ν̂², `[]`; λ and σ², `[B]`; ḡ and the error ε_θ − ε,
/// `[B, a]`.
pub(super) fn inputs(guide: &Guide, error: Tensor) -> Vec<Tensor> {
    let Guide { averages, lambda, sigma_squared, gradient, .. } = guide;
    vec![
        averages.nu_squared.clone(),
        lambda.clone(),
        sigma_squared.clone(),
        gradient.clone(),
        error,
    ]
}

/// The metrics of guidance from the numbers of [`inputs`], one tensor after the other; none without
/// guidance. `t` is each sample's, in 1..=`steps`.
pub(super) fn measure(numbers: &[f32], t: &[u32], steps: usize, delta: f32) -> Measured {
    let [nu_squared, rows @ ..] = numbers else { return Measured::new() };
    let (lambda, rows) = rows.split_at(t.len());
    let (sigma_squared, rows) = rows.split_at(t.len());
    let (gradient, error) = rows.split_at(rows.len() / 2);
    let lambda_mean = mean(lambda.iter().copied());
    let [low, median, high] = quantiles(lambda);
    let width = gradient.len() / t.len();
    let cosines =
        gradient.chunks(width).zip(error.chunks(width)).map(|(one, other)| cosine(one, other));
    let mut measured = vec![
        ("lambda_mean", lambda_mean),
        ("lambda_quantile_10", low),
        ("lambda_quantile_50", median),
        ("lambda_quantile_90", high),
        ("lambda_above_99_share", mean(lambda.iter().map(|lambda| f32::from(*lambda > 0.99)))),
        ("variance_ratio", mean(sigma_squared.iter().copied()) / (nu_squared + delta)),
        ("guidance_cosine", mean(cosines)),
    ];
    let fifths = FIFTHS.into_iter().zip(by_fifth(lambda, t, steps));
    measured.extend(fifths.filter_map(|(name, mean)| Some((name, mean?))));
    measured
}

fn mean(values: impl ExactSizeIterator<Item = f32>) -> f32 {
    let count = values.len() as f64;
    (values.map(f64::from).sum::<f64>() / count) as f32
}

/// Quantiles at 10 %, 50 % and 90 %, linear between the two nearest values.
fn quantiles(values: &[f32]) -> [f32; 3] {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    [0.1, 0.5, 0.9].map(|share| {
        let place = share * (sorted.len() - 1) as f32;
        let (below, above) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
        below + (above - below) * place.fract()
    })
}

/// The mean of each fifth of the chain of which there is a sample.
fn by_fifth(lambda: &[f32], t: &[u32], steps: usize) -> [Option<f32>; FIFTHS.len()] {
    let mut sums = [(0.0, 0); FIFTHS.len()];
    for (lambda, t) in lambda.iter().zip(t) {
        let (sum, count) = &mut sums[FIFTHS.len() * (*t as usize - 1) / steps];
        *sum += f64::from(*lambda);
        *count += 1;
    }
    sums.map(|(sum, count)| (count > 0).then(|| (sum / f64::from(count)) as f32))
}

/// The cosine between two vectors; 0 where one is 0.
fn cosine(one: &[f32], other: &[f32]) -> f32 {
    let dot = |x: &[f32], y: &[f32]| x.iter().zip(y).map(|(x, y)| x * y).sum::<f32>();
    let size = (dot(one, one) * dot(other, other)).sqrt();
    if size == 0.0 { 0.0 } else { dot(one, other) / size }
}
