//! Guidance at noisy actions, judged by true slopes.

use quad_run::results::statistics::mean;

use super::grid::Grid;
use super::ranks::rank_correlation;
use super::slopes::{DIRECTIONS, Sample};

const WEIGHTS: [&str; 7] = [
    "λ = 0",
    "λ = 1",
    "best constant",
    "mean λ of each t",
    "shuffled λ",
    "QUAD's λ",
    "1, at the denoised estimate",
];
/// Place of QUAD's λ among them.
const QUAD: usize = 5;

/// Tables of weights, of directions, and of each t. `outside` has the fraction of actions that are
/// left out, for t = 1..T; `delta` is in units of squared slopes.
pub fn mechanism(
    mut samples: Vec<Sample>,
    states: usize,
    outside: &[f64],
    (tau, delta): (f64, f64),
) -> [Grid; 3] {
    let all = Vec::from_iter(&samples);
    let center = mean_of(&all, |of| of.estimate);
    let nu_squared = mean_of(&all, |of| (of.estimate - center).powi(2)); // Eq. 23
    let mut by_state = vec![Vec::new(); states];
    for sample in &mut samples {
        sample.lambda = nu_squared / (nu_squared + sample.variance / tau + delta); // Eq. 24
        by_state[sample.state].push(&*sample);
    }
    by_state.retain(|state| !state.is_empty());
    let steps = outside.len();
    let table = |title, columns: &[_], names, numbers: &dyn Fn(&[&Sample]) -> Vec<f64>| {
        Grid::of(title, columns, names, &by_state, |drawn| {
            numbers(&Vec::from_iter(drawn.iter().flat_map(|samples| samples.iter().copied())))
        })
    };
    let of_steps = outside.iter().zip(1..).map(|(outside, t)| {
        let actions = by_state.iter().flatten().filter(|sample| sample.t == t).count();
        format!("t = {t}: {actions} actions, {:.0} % left out", 100.0 * outside)
    });
    [
        table(
            "Risk of weights (Eq. 14), over the mean square of l̄",
            &["mean weight", "risk", "above QUAD's λ", "each at its best scale"],
            Vec::from(WEIGHTS.map(str::to_owned)),
            &|samples| weights(samples, steps),
        ),
        table(
            "Slopes along gradients",
            &["claimed", "true", "true / claimed"],
            Vec::from(DIRECTIONS.map(str::to_owned)),
            &directions,
        ),
        table(
            "Noisy actions: rank correlations, errors within 1.96 σ, and the share of the true slopes' mean square that is not the rollouts' noise",
            &["mean λ", "l̄ with truth", "σ² with squared error", "within 1.96 σ", "not noise"],
            of_steps.chain(["all".to_owned()]).collect(),
            &|samples| {
                let by_t = (1..=steps).flat_map(|t| agreement(&of_t(samples, t)));
                by_t.chain(agreement(samples)).collect()
            },
        ),
    ]
}

fn mean_of(samples: &[&Sample], value: impl Fn(&Sample) -> f64) -> f64 {
    mean(&Vec::from_iter(samples.iter().map(|sample| value(sample))))
}

fn of_t<'a>(samples: &[&'a Sample], t: usize) -> Vec<&'a Sample> {
    samples.iter().copied().filter(|sample| sample.t == t).collect()
}

/// The mean square of the true slopes, without the rollouts' noise.
fn true_square(samples: &[&Sample]) -> f64 {
    mean_of(samples, |of| of.truth.powi(2) - of.noise)
}

/// The four numbers of each weight w: its mean, its risk E[(w·l)²] − 2·E[w·l·truth] + E[truth²], and
/// the risk above QUAD's, as they are and with both multiplied by their best factors.
fn weights(samples: &[&Sample], steps: usize) -> Vec<f64> {
    let square = mean_of(samples, |of| of.estimate.powi(2));
    let best = (mean_of(samples, |of| of.estimate * of.truth) / square).max(0.0);
    // The means of λ and λ² at each t.
    let lambdas = Vec::from_iter((1..=steps).map(|t| {
        let samples = of_t(samples, t);
        [mean_of(&samples, |of| of.lambda), mean_of(&samples, |of| of.lambda.powi(2))]
    }));
    // w, (w·l)² and w·l·truth of each weight.
    let moments = |of: &Sample| {
        let times = |w: f64| [w, (w * of.estimate).powi(2), w * of.estimate * of.truth];
        let [lambda, squared] = lambdas[of.t - 1];
        let [by_t, mut shuffled] = [times(lambda); 2];
        // Over all ways to draw another sample's λ.
        shuffled[1] = squared * of.estimate.powi(2);
        let denoised = [1.0, of.denoised.powi(2), of.denoised * of.truth];
        [times(0.0), times(1.0), times(best), by_t, shuffled, times(of.lambda), denoised]
    };
    let mut means = [[0.0; 3]; WEIGHTS.len()];
    for of in samples {
        let pairs = means.iter_mut().flatten().zip(moments(of).into_iter().flatten());
        pairs.for_each(|(mean, moment)| *mean += moment / samples.len() as f64);
    }
    let truth = true_square(samples);
    let risk = |[_, own, product]: [f64; 3]| (own - 2.0 * product + truth) / square;
    let scaled = |[_, own, product]: [f64; 3]| {
        let gained = if own > 0.0 { product.max(0.0).powi(2) / own } else { 0.0 };
        (truth - gained) / square
    };
    let of_weight = |of: [f64; 3]| {
        let quad = means[QUAD];
        [of[0], risk(of), risk(of) - risk(quad), scaled(of) - scaled(quad)]
    };
    means.into_iter().flat_map(of_weight).collect()
}

/// The three numbers of each direction.
fn directions(samples: &[&Sample]) -> Vec<f64> {
    let of_direction = |which: usize| {
        let [claimed, truth] = [0, 1].map(|side| mean_of(samples, |of| of.along[which][side]));
        [claimed, truth, truth / claimed]
    };
    (0..DIRECTIONS.len()).flat_map(of_direction).collect()
}

/// The five numbers of a t.
fn agreement(samples: &[&Sample]) -> [f64; 5] {
    let column = |value: fn(&Sample) -> f64| Vec::from_iter(samples.iter().map(|of| value(of)));
    let truth = column(|of| of.truth);
    let error = column(|of| (of.estimate - of.truth).powi(2) - of.noise);
    let is_within = |of: &Sample| {
        let deviation = (of.variance + of.noise).sqrt();
        f64::from(u8::from((of.estimate - of.truth).abs() <= 1.96 * deviation))
    };
    [
        mean_of(samples, |of| of.lambda),
        rank_correlation(&column(|of| of.estimate), &truth),
        rank_correlation(&column(|of| of.variance), &error),
        mean_of(samples, is_within),
        true_square(samples) / mean_of(samples, |of| of.truth.powi(2)),
    ]
}

#[cfg(test)]
mod tests;
