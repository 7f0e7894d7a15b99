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

/// A noisy action and its λ.
struct Weighted<'a> {
    sample: &'a Sample,
    lambda: f64,
}

/// Tables of weights, of directions, and of each t. `outside` has the fraction of actions that are
/// left out, for t = 1..T; `delta` is in units of squared slopes.
pub fn mechanism(
    samples: &[Sample],
    states: usize,
    outside: &[f64],
    (tau, delta): (f64, f64),
) -> [Grid; 3] {
    let column = |of: fn(&Sample) -> f64| Vec::from_iter(samples.iter().map(of));
    let estimates = column(|sample| sample.estimate);
    let center = mean(&estimates);
    let squares = estimates.iter().map(|estimate| (estimate - center).powi(2));
    let nu_squared = mean(&Vec::from_iter(squares)); // Eq. 23
    let mut by_state = Vec::from_iter((0..states).map(|_| Vec::new()));
    for sample in samples {
        let lambda = nu_squared / (nu_squared + sample.variance / tau + delta); // Eq. 24
        by_state[sample.state].push(Weighted { sample, lambda });
    }
    by_state.retain(|state| !state.is_empty());
    let steps = outside.len();
    let table = |title: &str, columns: &[_], names, numbers: &dyn Fn(&[&Weighted]) -> Vec<f64>| {
        Grid::of(title, columns, names, by_state.len(), |drawn| {
            numbers(&Vec::from_iter(drawn.iter().flat_map(|state| &by_state[*state])))
        })
    };
    let names = |names: &[&str]| Vec::from_iter(names.iter().map(|name| name.to_string()));
    let of_steps = outside.iter().zip(1..).map(|(outside, t)| {
        let actions = samples.iter().filter(|sample| sample.t == t).count();
        format!("t = {t}: {actions} actions, {:.0} % left out", 100.0 * outside)
    });
    [
        table(
            "Risk of weights (Eq. 14), over the mean square of l̄",
            &["mean weight", "risk", "above QUAD's λ", "each at its best scale"],
            names(&WEIGHTS),
            &|items| weights(items, steps),
        ),
        table(
            "Slopes along gradients",
            &["claimed", "true", "true / claimed"],
            names(&DIRECTIONS),
            &directions,
        ),
        table(
            "Noisy actions: λ, rank correlations, errors within 1.96 σ, and the part of the true slopes that is not the rollouts' noise",
            &["mean λ", "l̄ with truth", "σ² with squared error", "within 1.96 σ", "not noise"],
            of_steps.collect(),
            &|items| (1..=steps).flat_map(|t| of_step(items, t)).collect(),
        ),
    ]
}

fn mean_of(items: &[&Weighted], value: impl Fn(&Sample, f64) -> f64) -> f64 {
    mean(&Vec::from_iter(items.iter().map(|item| value(item.sample, item.lambda))))
}

fn of_t<'a>(items: &[&'a Weighted<'a>], t: usize) -> Vec<&'a Weighted<'a>> {
    items.iter().copied().filter(|item| item.sample.t == t).collect()
}

/// The second moment of the true slope, without the rollouts' noise.
fn true_square(items: &[&Weighted]) -> f64 {
    mean_of(items, |of, _| of.truth.powi(2) - of.noise)
}

/// The four numbers of each weight: its mean, its risk E[(w·l)²] − 2·E[w·l·truth] + E[truth²], and
/// the risk above QUAD's, as they are and with both multiplied by their best factors.
fn weights(items: &[&Weighted], steps: usize) -> Vec<f64> {
    let square = mean_of(items, |of, _| of.estimate.powi(2));
    let product = mean_of(items, |of, _| of.estimate * of.truth);
    let (mut by_step, mut shuffled, mut product_by_step) = (0.0, 0.0, 0.0);
    for items_of_t in (1..=steps).map(|t| of_t(items, t)).filter(|of_t| !of_t.is_empty()) {
        let share = items_of_t.len() as f64 / items.len() as f64;
        let lambda = mean_of(&items_of_t, |_, lambda| lambda);
        let square = share * mean_of(&items_of_t, |of, _| of.estimate.powi(2));
        by_step += lambda.powi(2) * square;
        // Over all ways to draw another sample's λ.
        shuffled += mean_of(&items_of_t, |_, lambda| lambda.powi(2)) * square;
        product_by_step += share * lambda * mean_of(&items_of_t, |of, _| of.estimate * of.truth);
    }
    let (best, lambda) = ((product / square).max(0.0), mean_of(items, |_, lambda| lambda));
    let quad = [
        mean_of(items, |of, lambda| (lambda * of.estimate).powi(2)),
        mean_of(items, |of, lambda| lambda * of.estimate * of.truth),
    ];
    let denoised = [
        mean_of(items, |of, _| of.denoised.powi(2)),
        mean_of(items, |of, _| of.denoised * of.truth),
    ];
    // Mean of w, E[(w·l)²] and E[w·l·truth], in the order of their names.
    let moments = [
        [0.0, 0.0, 0.0],
        [1.0, square, product],
        [best, best.powi(2) * square, best * product],
        [lambda, by_step, product_by_step],
        [lambda, shuffled, product_by_step],
        [lambda, quad[0], quad[1]],
        [1.0, denoised[0], denoised[1]],
    ];
    let truth = true_square(items);
    let risk = |[_, own, product]: [f64; 3]| (own - 2.0 * product + truth) / square;
    let scaled = |[_, own, product]: [f64; 3]| {
        let gained = if own > 0.0 { product.max(0.0).powi(2) / own } else { 0.0 };
        (truth - gained) / square
    };
    let of_weight = |of: [f64; 3]| {
        let quad = moments[QUAD];
        [of[0], risk(of), risk(of) - risk(quad), scaled(of) - scaled(quad)]
    };
    moments.into_iter().flat_map(of_weight).collect()
}

/// The three numbers of each direction.
fn directions(items: &[&Weighted]) -> Vec<f64> {
    let of_direction = |which: usize| {
        let [claimed, truth] = [0, 1].map(|side| mean_of(items, |of, _| of.along[which][side]));
        [claimed, truth, truth / claimed]
    };
    (0..DIRECTIONS.len()).flat_map(of_direction).collect()
}

/// The five numbers of a t.
fn of_step(items: &[&Weighted], t: usize) -> [f64; 5] {
    let items = of_t(items, t);
    let column =
        |value: fn(&Sample) -> f64| Vec::from_iter(items.iter().map(|item| value(item.sample)));
    let truth = column(|of| of.truth);
    let error = column(|of| (of.estimate - of.truth).powi(2) - of.noise);
    let is_within = |of: &Sample| {
        let deviation = (of.variance + of.noise).sqrt();
        f64::from(u8::from((of.estimate - of.truth).abs() <= 1.96 * deviation))
    };
    [
        mean_of(&items, |_, lambda| lambda),
        rank_correlation(&column(|of| of.estimate), &truth),
        rank_correlation(&column(|of| of.variance), &error),
        mean_of(&items, |of, _| is_within(of)),
        true_square(&items) / mean_of(&items, |of, _| of.truth.powi(2)),
    ]
}

#[cfg(test)]
mod tests;
