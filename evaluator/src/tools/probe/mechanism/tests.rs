//! Statistics of critics whose errors are known.

use super::super::noisy::Noisy;
use super::super::oracle::Query;
use super::super::slopes::measure;
use super::super::states::State;
use super::*;

/// Samples at s = [s, 1] of the value s·a − |a|²/2, whose gradient is s − a, in rollouts with noise of
/// ±`noise`·(a₁ + a₂) and any other of their own. At t the two critics' mean is wrong by t/2 in the
/// first dimension, and each of them by ±t more.
fn samples(noise: f64) -> Vec<Sample> {
    // The four ways to draw two signs.
    let rollouts = [[1, 1], [1, 3], [3, 1], [3, 3]];
    let states = [0.5, -1.0, 2.0, 0.75].into_iter().zip(rollouts).map(|(s, rollouts)| State {
        observation: vec![s, 1.0],
        rollouts: Vec::from(rollouts),
        ..State::default()
    });
    let states = Vec::from_iter(states);
    let at = |(state, t): (usize, usize)| {
        let action: [f32; 2] = [[0.25, -0.5], [-0.5, 0.5]][t - 1];
        let pairs = states[state].observation.iter().zip(&action);
        let gradient = Vec::from_iter(pairs.map(|(s, a)| f64::from(s - a)));
        let of_critic = |sign: f64| vec![gradient[0] + t as f64 * (0.5 + sign), gradient[1]];
        Noisy {
            state,
            t,
            action: Vec::from(action),
            direction: Vec::from([[1.0, 0.0], [0.6, 0.8]][t - 1]),
            gradients: vec![of_critic(1.0), of_critic(-1.0)],
            denoised: gradient,
        }
    };
    let noisy = Vec::from_iter((0..4).flat_map(|state| [(state, 1), (state, 2)]).map(at));
    let value = |Query { state, action, seed }: &Query<'_>| {
        let signed = (*seed as f64 - 2.0) * noise;
        let pairs = state.observation.iter().zip(action);
        let pairs = pairs.map(|(s, a)| (f64::from(*s), f64::from(*a)));
        pairs.map(|(s, a)| s * a - a * a / 2.0 + signed * a).sum::<f64>() + 9.0 * *seed as f64
    };
    let returns = |queries: &[Query<'_>]| Ok(queries.iter().map(value).collect());
    measure(&noisy, &states, 0.125, returns).unwrap()
}

fn close(found: f64, expected: f64, what: &str) {
    assert!((found - expected).abs() < 1e-12, "{what}: {found}, not {expected}");
}

#[test]
fn slopes_are_those_of_value_and_critics() {
    let samples = samples(0.0);
    for (sample, truth) in samples.iter().zip([0.25, 0.6 + 0.4]) {
        close(sample.truth, truth, "truth");
        close(sample.noise, 0.0, "noise");
        close(sample.denoised, truth, "denoised");
        let [u, t] = [[1.0, 0.6][sample.t - 1], sample.t as f64];
        close(sample.estimate, truth + u * t / 2.0, "l̄");
        close(sample.variance, (u * t).powi(2), "σ²");
        close(sample.along[2][0], sample.along[2][1], "slope along the true gradient");
    }
    // Critics at t = 1 of s = 0.5 say [1.75, 1.5] and [−0.25, 1.5], and [0.75, 1.5] together.
    let [claimed, truth] = samples[0].along[1];
    close(claimed, 0.75f64.hypot(1.5), "size");
    close(truth, (0.25 * 0.75 + 1.5 * 1.5) / claimed, "slope along the mean gradient");
    let [claimed, _] = samples[0].along[0];
    close(claimed, (1.75f64.hypot(1.5) + 0.25f64.hypot(1.5)) / 2.0, "mean size");
}

#[test]
fn risks_are_those_of_the_known_errors() {
    let samples = samples(0.0);
    let [weights, _, steps] = mechanism(samples.clone(), 4, &[0.25, 0.5], (0.5, 0.0));
    let mean_of = |of: &dyn Fn(&Sample) -> f64| mean(&Vec::from_iter(samples.iter().map(of)));
    let square = mean_of(&|of| of.estimate.powi(2));
    let center = mean_of(&|of| of.estimate);
    let nu_squared = square - center * center;
    // 0.5² and (0.6·1)² are the squared errors; 1² and (0.6·2)² are σ², with τ = 0.5.
    let one = (0.25 + 0.36) / 2.0 / square;
    let lambda = |of: &Sample| nu_squared / (nu_squared + 2.0 * [1.0, 1.44][of.t - 1]);
    let best = mean_of(&|of| of.estimate * of.truth) / square;
    let risk = |weight: &dyn Fn(&Sample) -> f64| {
        mean_of(&|of| (weight(of) * of.estimate - of.truth).powi(2)) / square
    };
    // In all samples of a t λ is the same, so the controls are QUAD.
    let quad = risk(&lambda);
    let expected = [risk(&|_| 0.0), one, risk(&|_| best), quad, quad, quad, 0.0];
    for ((name, found), expected) in weights.rows.iter().zip(expected) {
        close(found[1].value, expected, name);
        close(found[2].value, expected - quad, name);
    }
    close(weights.rows[2].1[0].value, best, "best constant");
    close(weights.rows[1].1[3].value, weights.rows[2].1[3].value, "risk at the best scale");
    for (row, variance) in steps.rows.iter().zip([1.0, 1.44]) {
        let found = Vec::from_iter(row.1.iter().map(|number| number.value));
        close(found[0], nu_squared / (nu_squared + 2.0 * variance), "λ");
        close(found[1], 1.0, "l̄ with truth");
        assert_eq!(found[3], 1.0);
        close(found[4], 1.0, "no noise");
    }
}

/// Over all ways to draw the rollouts, their noise cancels.
#[test]
fn noise_of_rollouts_is_subtracted() {
    let (exact, noisy) = (samples(0.0), samples(0.5));
    assert!(noisy.iter().any(|of| of.noise > 0.1));
    let pairs = exact.iter().zip(&noisy);
    let left = pairs.map(|(exact, noisy)| (noisy.truth - exact.truth).powi(2) - noisy.noise);
    close(mean(&Vec::from_iter(left)), 0.0, "noise");
}

#[test]
fn shuffled_weights_are_drawn_within_their_t() {
    let sample =
        |t, estimate, lambda| Sample { t, estimate, lambda, truth: 1.0, ..Sample::default() };
    let samples = [sample(1, 1.0, 1.0), sample(1, 3.0, 0.5), sample(2, -2.0, 0.25)];
    let found = weights(&Vec::from_iter(&samples), 2);
    let square = 14.0 / 3.0;
    // The two of t = 1 with their mean λ, ¾, and in all four pairs of slope and λ.
    let by_step = (0.25f64.powi(2) + 1.25f64.powi(2) + 1.5f64.powi(2)) / 3.0;
    close(found[4 * 3 + 1], by_step / square, "mean λ");
    let shuffled = ((0.0 + 0.25 + 4.0 + 0.25) / 2.0 + 1.5f64.powi(2)) / 3.0;
    close(found[4 * 4 + 1], shuffled / square, "shuffled λ");
}
