//! Tests of `squashed.rs`, in float64 where numbers are compared with numerical ones.

use super::*;
use candle_core::{Device, Var};

/// One state and as many dimensions as numbers.
fn row(numbers: &[f64]) -> Tensor {
    Tensor::from_slice(numbers, (1, numbers.len()), &Device::Cpu).unwrap()
}

fn normal(mean: &[f64], log_std: &[f64]) -> Normal {
    Normal { mean: row(mean), log_std: row(log_std) }
}

fn number(x: &Tensor) -> f64 {
    x.flatten_all().unwrap().to_vec1::<f64>().unwrap()[0]
}

/// The density integrates to 1 over the actions, and gives the mean action that tanh of normal
/// numbers has.
#[test]
fn the_density_is_that_of_the_tanh_of_a_normal_number() {
    const POINTS: usize = 200_000;
    for (mean, log_std) in [(0.0, -1.0), (0.8, 0.2), (-1.5, -0.5)] {
        let width = 2.0 / POINTS as f64;
        let actions: Vec<f64> = (0..POINTS).map(|i| -1.0 + (i as f64 + 0.5) * width).collect();
        let column = Tensor::from_slice(&actions, (POINTS, 1), &Device::Cpu).unwrap();
        let all = |x: f64| Tensor::full(x, (POINTS, 1), &Device::Cpu).unwrap();
        let distributions = Normal { mean: all(mean), log_std: all(log_std) };
        let densities: Vec<f64> =
            distributions.log_density(&column).unwrap().exp().unwrap().to_vec1().unwrap();
        let mass: f64 = densities.iter().sum::<f64>() * width;
        let of_actions: f64 =
            densities.iter().zip(&actions).map(|(p, a)| p * a).sum::<f64>() * width;
        // The same mean over the normal number, within eight σ.
        let z = |i: usize| -8.0 + (i as f64 + 0.5) * 16.0 / POINTS as f64;
        let weigh = |z: f64| {
            (-0.5 * z * z).exp() / (2.0 * std::f64::consts::PI).sqrt() * 16.0 / POINTS as f64
        };
        let expected: f64 =
            (0..POINTS).map(z).map(|z| weigh(z) * (mean + log_std.exp() * z).tanh()).sum();
        assert!(
            (mass - 1.0).abs() < 1e-4 && (of_actions - expected).abs() < 1e-4,
            "{mass} {of_actions} {expected}"
        );
    }
}

#[test]
fn a_drawn_action_has_the_density_of_a_given_one() {
    let distribution = normal(&[0.3, -0.7], &[-0.4, 0.1]);
    let noise = row(&[0.5, -1.2]).unsqueeze(1).unwrap();
    let Drawn { actions, log_density } = distribution.draw(&noise).unwrap();
    assert_eq!((actions.dims(), log_density.dims()), (&[1, 1, 2][..], &[1, 1][..]));
    let again = distribution.log_density(&actions.squeeze(1).unwrap()).unwrap();
    assert!((number(&log_density) - number(&again)).abs() < 1e-10);
}

/// Where tanh(u) is 1 in float32, the density is still that of u: log(1 − tanh² u) is 2·(log 2 − u)
/// there.
#[test]
fn densities_are_finite_where_actions_round_to_one() {
    let one = |x: f32| Tensor::from_slice(&[x], (1, 1), &Device::Cpu).unwrap();
    let distribution = Normal { mean: one(30.0), log_std: one(0.0) };
    let drawn = distribution.draw(&one(0.0).unsqueeze(1).unwrap()).unwrap();
    let found = drawn.log_density.flatten_all().unwrap().to_vec1::<f32>().unwrap()[0];
    let expected = -0.5 * (2.0 * std::f32::consts::PI).ln() - 2.0 * (2f32.ln() - 30.0);
    assert_eq!(drawn.actions.flatten_all().unwrap().to_vec1::<f32>().unwrap(), [1.0]);
    assert!((found - expected).abs() < 1e-4, "{found} {expected}");
}

/// A number that depends on drawn actions, their densities, and the density of a given action.
fn outcome(distribution: &Normal) -> Tensor {
    let noise = Tensor::new(&[[[0.4, -1.1], [-0.6, 0.9]]], &Device::Cpu).unwrap();
    let Drawn { actions, log_density } = distribution.draw(&noise).unwrap();
    let weights = Tensor::new(&[[[1.0, -2.0], [0.5, 3.0]]], &Device::Cpu).unwrap();
    let drawn =
        ((actions * weights).unwrap().sum_all().unwrap() + log_density.sum_all().unwrap()).unwrap();
    (drawn + distribution.log_density(&row(&[0.2, -0.95])).unwrap().sum_all().unwrap()).unwrap()
}

#[test]
fn gradients_are_the_numerical_ones() {
    let (mean, log_std) = ([0.3, -0.7], [-0.4, 0.1]);
    let vars = [mean, log_std].map(|numbers| Var::from_tensor(&row(&numbers)).unwrap());
    let distribution =
        Normal { mean: vars[0].as_tensor().clone(), log_std: vars[1].as_tensor().clone() };
    let gradients = outcome(&distribution).backward().unwrap();
    for (which, var) in vars.iter().enumerate() {
        let found: Vec<f64> = gradients.get(var).unwrap().flatten_all().unwrap().to_vec1().unwrap();
        for (i, found) in found.iter().enumerate() {
            let moved = |by: f64| {
                let mut numbers = [mean, log_std];
                numbers[which][i] += by;
                number(&outcome(&normal(&numbers[0], &numbers[1])))
            };
            let expected = (moved(1e-5) - moved(-1e-5)) / 2e-5;
            assert!(
                (found - expected).abs() < 1e-6 * expected.abs().max(1.0),
                "{found} {expected}"
            );
        }
    }
}
