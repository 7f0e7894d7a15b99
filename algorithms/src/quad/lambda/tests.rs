//! Tests of `quad/lambda.rs`. Expected are NumPy's numbers; the golden folders have more of them.

use super::*;

const LAMBDA: [f32; 7] = [0.2, 0.995, 0.5, 0.9, 1.0, 0.3, 0.4];
const T: [u32; 7] = [1, 2, 3, 1, 7, 3, 4];

fn close(found: &[f32], expected: &[f32]) {
    let is_close =
        found.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-6);
    assert!(found.len() == expected.len() && is_close, "{found:?}, but expected is {expected:?}");
}

#[test]
fn quantiles_and_means_of_fifths_are_numpys() {
    close(&quantiles(&LAMBDA), &[0.26, 0.5, 0.997]);
    close(&quantiles(&[0.5]), &[0.5; 3]);
    // No t is in the fourth fifth of 1…7.
    let fifths = by_fifth(&LAMBDA, &T, 7);
    close(&Vec::from_iter(fifths.into_iter().flatten()), &[0.698_333_3, 0.4, 0.4, 1.0]);
    assert_eq!(fifths[3], None);
    let each = [1, 2, 3, 4, 5].map(|t| t as f32 / 10.0);
    assert_eq!(by_fifth(&each, &[1, 2, 3, 4, 5], 5), each.map(Some));
}

#[test]
fn a_batch_is_measured_in_one_pass() {
    let (lambda, sigma_squared) = ([0.995, 0.5], [0.1, 0.3]);
    let (gradient, error) = ([1.0, 0.0, 0.0, 0.0], [3.0, 4.0, 1.0, 0.0]);
    let numbers = [&[0.4, 0.25][..], &lambda, &sigma_squared, &gradient, &error].concat();
    let found = measure(&numbers, &[1, 2], 2, 0.1);
    let value = |name: &str| found.iter().find(|(known, _)| *known == name).unwrap().1;
    // σ²/(ν̂² + δ); the mean of the cosine 0.6 and, of a gradient that is 0, of 0.
    let names = [
        "delta_share",
        "lambda_mean",
        "lambda_above_99_share",
        "variance_ratio",
        "guidance_cosine",
    ];
    close(&names.map(value), &[0.25, 0.7475, 0.5, 0.4, 0.3]);
    let fifths =
        Vec::from_iter(found.into_iter().filter(|(name, _)| name.starts_with("lambda_fifth")));
    assert_eq!(fifths, [("lambda_fifth_1", 0.995), ("lambda_fifth_3", 0.5)]);
}
