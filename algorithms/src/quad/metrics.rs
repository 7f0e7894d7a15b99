//! The metrics of QUAD; those of λ and guidance over a batch are computed on the CPU.

use super::guidance::Guide;
use crate::definition::{Metric, metrics};
use crate::losses::Measured;
use candle_core::Tensor;

pub(super) const METRICS: &[Metric] = &metrics! {
    target_q_mean held_out: "Mean over the batch of the critics' target y (Eq. 20). A value that grows without end is overestimation.";
    critic_loss ["critic loss"] held_out: "Mean over critics and batch of (y − Q_k(s, a))² with y = r + γ·mask·Q_LCB(s', a'), Q_LCB = mean_k Q̂_k − ρ·std_k Q̂_k (Eq. 20).";
    bc_loss ["BC loss"] held_out: "Mean over batch and dimensions of (ε − ε_θ(a^t, s, t))², the behavior-cloning term of Eq. 19 before η. A network that always outputs 0 has loss 1; a policy that knows the data lies well below.";
    actor_loss held_out: "Eq. 19: η·(BC loss) + mean of λ·w(t)·ε_θ·ḡ, where ḡ is the Q-gradient (Eq. 10) over the mean of |Q̂_k(s, a)| and w(t) = √(1 − ᾱ_t).";
    eta ["η"]: "Strength η of behavior cloning (Eq. 19). With a threshold b it rises while the BC loss is above b and falls while it is below; without one, or without guidance, it is constant.";
    nu_squared: "ν̂²: moving average of the variance over the batch of the critics' mean alignment (Eq. 21–23).";
    critic_gradient_norm: "Global norm of the critics' gradient before clipping.";
    actor_gradient_norm: "Global norm of the actor's gradient before clipping.";
    learning_rate: "The actor's learning rate; falls to 0 along a cosine; online it is online_rate of the first.";
    delta_share: "Share of the batch, 0 to 1, in which δ is more than a hundredth of the denominator of λ (Eq. 24), so that it decides λ and not the critics. 0 with guidance dac and constant. This and all that follow are measured with guidance only.";
    lambda_mean ["λ"] held_out: "Mean over the batch of λ = ν̂²/(ν̂² + σ²/τ + δ) (Eq. 24), in (0, 1]: how far the critics' gradients are trusted. With guidance constant, mean or shuffled it is what they have in its place, as in all metrics of λ; 1 with dac.";
    lambda_quantile_10: "A tenth of the batch has a λ below this.";
    lambda_quantile_50: "Median of λ over the batch.";
    lambda_quantile_90: "A tenth of the batch has a λ above this.";
    lambda_fifth_1: "Mean of λ over the samples whose denoising step t is in the first fifth of 1…T, the least noisy; with T = 5, as in the paper, it is t = 1.";
    lambda_fifth_2: "Mean of λ over the samples whose t is in the second fifth.";
    lambda_fifth_3: "Mean of λ over the samples whose t is in the third fifth.";
    lambda_fifth_4: "Mean of λ over the samples whose t is in the fourth fifth.";
    lambda_fifth_5: "Mean of λ over the samples whose t is in the last fifth, the noisiest.";
    lambda_above_99_share: "Share of the batch, 0 to 1, whose λ is above 0.99: there QUAD is DAC to within 1 %.";
    variance_ratio: "Mean over the batch of σ²/(ν̂² + δ), which is what λ falls with: the critics' disagreement on the alignment (Eq. 22) over how much it varies between samples.";
    guidance_cosine: "Mean over the batch of the cosine between the gradients of guidance, ḡ, and of behavior cloning, ε_θ − ε, with respect to ε_θ: 1 where both pull in one direction, −1 where they pull against each other.";
};

/// Metrics of the mean λ over each fifth of the denoising steps.
const FIFTHS: [&str; 5] =
    ["lambda_fifth_1", "lambda_fifth_2", "lambda_fifth_3", "lambda_fifth_4", "lambda_fifth_5"];

/// The tensors from which [`measure_lambda`] computes: ν̂², `[]`; λ and σ², `[B]`; ḡ and the error ε_θ − ε,
/// `[B, a]`.
pub(super) fn lambda_inputs(guide: &Guide, error: Tensor) -> Vec<Tensor> {
    vec![
        guide.averages.nu_squared.clone(),
        guide.lambda.clone(),
        guide.sigma_squared.clone(),
        guide.gradient.clone(),
        error,
    ]
}

/// The metrics of guidance from the numbers of [`lambda_inputs`], one tensor after the other; none without
/// guidance. `t` is each sample's, in 1..=`steps`.
pub(super) fn measure_lambda(numbers: &[f32], t: &[u32], steps: usize, delta: f32) -> Measured {
    let [nu_squared, rows @ ..] = numbers else { return Measured::new() };
    let (lambda, rows) = rows.split_at(t.len());
    let (sigma_squared, rows) = rows.split_at(t.len());
    let (gradient, error) = rows.split_at(rows.len() / 2);
    let lambda_mean = mean(lambda.iter().copied());
    let [low, median, high] = quantiles(lambda);
    let width = gradient.len() / t.len();
    let rows = gradient.chunks(width).zip(error.chunks(width));
    let above_99 = lambda.iter().map(|lambda| f32::from(*lambda > 0.99));
    let variance = mean(sigma_squared.iter().copied());
    let mut measured = vec![
        ("lambda_mean", lambda_mean),
        ("lambda_quantile_10", low),
        ("lambda_quantile_50", median),
        ("lambda_quantile_90", high),
        ("lambda_above_99_share", mean(above_99)),
        ("variance_ratio", variance / (nu_squared + delta)),
        ("guidance_cosine", mean(rows.map(|(g, error)| cosine(g, error)))),
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
        let [below, above] = [place.floor(), place.ceil()].map(|place| sorted[place as usize]);
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
    match size {
        0.0 => 0.0,
        _ => dot(one, other) / size,
    }
}
