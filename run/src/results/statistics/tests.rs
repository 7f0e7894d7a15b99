//! Tests of statistics.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::*;

/// Results of rliable and SciPy, from `statistics.py` beside this file.
#[derive(Deserialize)]
struct Reference {
    methods: BTreeMap<String, Method>,
    thresholds: Vec<f64>,
    /// Value, low, high.
    improvement: [f64; 3],
    differences: Vec<Vec<f64>>,
    p_values: Vec<f64>,
}

#[derive(Deserialize)]
struct Method {
    scores: Runs,
    values: Vec<f64>,
    low: Vec<f64>,
    high: Vec<f64>,
    profile: Vec<f64>,
}

fn reference() -> Reference {
    serde_json::from_str(include_str!("statistics.json")).unwrap()
}

fn is_close(one: f64, other: f64) -> bool {
    (one - other).abs() <= 1e-12 * other.abs().max(1.0)
}

/// Intervals are random: with 10,000 resamples, their ends vary by about 1 % of the width.
fn agree(estimate: Estimate, value: f64, low: f64, high: f64) {
    assert!(is_close(estimate.value, value), "{estimate:?} {value}");
    for (ours, theirs) in [(estimate.low, low), (estimate.high, high)] {
        assert!((ours.unwrap() - theirs).abs() < 0.05 * (high - low), "{estimate:?} {low} {high}");
    }
}

#[test]
fn estimates_are_those_of_rliable() {
    let reference = reference();
    for method in reference.methods.values() {
        let statistics = |drawn: &[Runs]| {
            [interquartile_mean, mean_of_means, median_of_means, optimality_gap]
                .map(|statistic| statistic(&drawn[0]))
                .to_vec()
        };
        for (index, estimate) in estimates(&[&method.scores], statistics).into_iter().enumerate() {
            agree(estimate, method.values[index], method.low[index], method.high[index]);
        }
        for (threshold, share) in reference.thresholds.iter().zip(&method.profile) {
            assert!(is_close(fraction_above(&method.scores, *threshold), *share), "{threshold}");
        }
    }
    let [x, y] = ["x", "y"].map(|name| &reference.methods[name].scores);
    let improvement = |drawn: &[Runs]| vec![probability_of_improvement(&drawn[0], &drawn[1])];
    let [value, low, high] = reference.improvement;
    agree(estimates(&[x, y], improvement)[0], value, low, high);
}

#[test]
fn intervals_are_repeatable_and_need_two_seeds() {
    let estimate = |runs: Runs| estimates(&[&runs], |drawn| vec![mean_of_means(&drawn[0])])[0];
    let runs = vec![vec![1.0, 2.0, 4.0], vec![3.0, 5.0]];
    assert_eq!(estimate(runs.clone()), estimate(runs));
    let single = estimate(vec![vec![1.0, 2.0], vec![3.0]]);
    assert_eq!((single.value, single.low, single.high), (2.25, None, None));
}

/// Of nine scores, ⌊9 / 4⌋ / 9 of the weight is cut at either end. With six and three of them in two
/// tasks, a score of the first has the weight 1/12, one of the second 1/6.
#[test]
fn the_interquartile_mean_weighs_tasks_alike() {
    let nine = vec![vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 100.0]];
    assert!(is_close(interquartile_mean(&nine), 4.0));
    let unequal = vec![vec![1.0; 6], vec![2.0; 3]];
    assert!(is_close(interquartile_mean(&unequal), 1.5));
    let unequal = vec![vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0], vec![7.0, 8.0, 9.0]];
    // 2/9 cuts 1, 2 and two thirds of 3; and 9, and a third of 8.
    let kept = (3.0 / 3.0 + 4.0 + 5.0 + 6.0) / 12.0 + (7.0 + 8.0 * 2.0 / 3.0) / 6.0;
    assert!(is_close(interquartile_mean(&unequal), kept * 9.0 / 5.0));
}

#[test]
fn sign_flips_give_the_p_values_of_scipy() {
    let Reference { differences, p_values, .. } = reference();
    for (count, p_value) in (1..).zip(&p_values) {
        assert!(is_close(sign_flip_test(&differences[..count].concat()), *p_value));
    }
    // For 17 differences, signs are drawn.
    assert_eq!(sign_flip_test(&[1.0; 17]), 1.0 / 10_001.0);
    let balanced: Vec<f64> = (0..17).map(|index| if index % 2 == 0 { 1.0 } else { -1.0 }).collect();
    assert_eq!(sign_flip_test(&balanced), 1.0);
    // Differences of 0 change no p-value.
    let p_value = sign_flip_test(&[[0.0; 16].to_vec(), differences[0].clone()].concat());
    assert!((p_value - p_values[0]).abs() < 0.02, "{p_value}");
}

#[test]
fn holms_procedure() {
    assert_eq!(holm(&[0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02]);
    assert_eq!(holm(&[0.9, 0.6]), [1.0, 1.0]);
    assert!(holm(&[]).is_empty());
}
