//! Tests: each custom operation against its plain implementation, values and gradients, at random shapes.

use crate::ensemble::Ensemble;
use crate::noise_predictor::NoisePredictor;
use crate::precision::Precision;
use crate::shape::{EnsembleShape, NoiseShape};
use crate::slices::{has_fast_body, modify};
use crate::weights::{Layout, Weights};
use candle_core::{Device, Tensor};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn tensor(generator: &mut ChaCha8Rng, shape: &[usize]) -> Tensor {
    let numbers: Vec<f32> = (0..shape.iter().product()).map(|_| generator.random_range(-1.0..1.0)).collect();
    Tensor::from_vec(numbers, shape, &Device::Cpu).unwrap()
}

/// Random weights; the biases, too.
fn weights(layout: Layout, generator: &mut ChaCha8Rng) -> Weights {
    let bias = (tensor(generator, &[layout.count()]) * 0.1).unwrap();
    let values = (Weights::initial(&layout, generator, &Device::Cpu).unwrap() + bias).unwrap();
    Weights::trainable(layout, &values).unwrap()
}

fn numbers(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

/// Equal up to rounding, relative to the root mean square.
fn close(what: &str, fast: &Tensor, plain: &Tensor) {
    assert_eq!(fast.dims(), plain.dims(), "{what}");
    let (fast, plain) = (numbers(fast), numbers(plain));
    let size = (plain.iter().map(|x| x * x).sum::<f32>() / plain.len() as f32).sqrt();
    for (i, (fast, plain)) in fast.iter().zip(&plain).enumerate() {
        assert!(
            (fast - plain).abs() <= 2e-5 * size.max(1e-3) + 1e-4 * plain.abs(),
            "{what} at {i}: {fast} for {plain}"
        );
    }
}

fn shape(generator: &mut ChaCha8Rng, outputs: usize) -> EnsembleShape {
    EnsembleShape {
        members: generator.random_range(1..5),
        observation_dim: generator.random_range(1..20),
        action_dim: generator.random_range(1..8),
        // Widths that AVX-512 serves, and others.
        hidden: [7, 24, 32, 64][generator.random_range(0..4)],
        outputs,
    }
}

#[test]
fn ensembles_give_the_plain_values() {
    for seed in 0..20 {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let outputs = generator.random_range(1..4);
        let shape = shape(&mut generator, outputs);
        let weights = weights(shape.layout(), &mut generator);
        let ensemble = Ensemble::new(shape, weights.copy().unwrap(), Precision::F32);
        let (states, repeat) = (generator.random_range(1..300), generator.random_range(1..12));
        let observations = tensor(&mut generator, &[states, shape.observation_dim]);
        let actions = tensor(&mut generator, &[states * repeat, shape.action_dim]);
        let fast = ensemble.outputs(&observations, &actions).unwrap();
        let plain = ensemble.plain_outputs(&observations, &actions).unwrap();
        close(&format!("{shape:?}, {states} × {repeat}"), &fast, &plain);
        let shape = EnsembleShape { action_dim: 0, ..shape };
        let ensemble = Ensemble::new(shape, self::weights(shape.layout(), &mut generator), Precision::F32);
        let none = Tensor::zeros((states, 0), candle_core::DType::F32, &Device::Cpu).unwrap();
        let plain = ensemble.plain_outputs(&observations, &none).unwrap();
        close("of states alone", &ensemble.state_outputs(&observations).unwrap(), &plain);
    }
}

#[test]
fn ensembles_give_the_plain_gradients() {
    for seed in 0..20 {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let outputs = generator.random_range(1..4);
        let shape = shape(&mut generator, outputs);
        let ensemble = Ensemble::new(shape, weights(shape.layout(), &mut generator), Precision::Bf16);
        // More than a tile of rows, mostly no whole number of tiles.
        let rows = generator.random_range(1..300);
        let observations = tensor(&mut generator, &[rows, shape.observation_dim]);
        let actions = tensor(&mut generator, &[rows, shape.action_dim]);
        let target = tensor(&mut generator, &[shape.members, rows, shape.outputs]);
        let loss = |outputs: Tensor| (outputs - &target).unwrap().sqr().unwrap().mean_all().unwrap();
        let fast = loss(ensemble.outputs(&observations, &actions).unwrap());
        let plain = loss(ensemble.plain_outputs(&observations, &actions).unwrap());
        close("loss", &fast, &plain);
        let plain = plain.backward().unwrap();
        let expected = ensemble.weights().gradient(&plain).unwrap();
        let fast = ensemble.weights().gradient(&fast.backward().unwrap()).unwrap();
        close(&format!("{shape:?}, {rows} rows"), &fast, &expected);
        assert!(numbers(&fast).iter().all(|x| x.is_finite() && *x != 0.0), "every weight has a part in the loss");

        // A loss that has the network in it twice.
        let twice = (loss(ensemble.outputs(&observations, &actions).unwrap())
            + loss(ensemble.outputs(&observations, &actions).unwrap()))
        .unwrap();
        let twice = ensemble.weights().gradient(&twice.backward().unwrap()).unwrap();
        close("twice", &twice, &(expected * 2.0).unwrap());
    }
}

#[test]
fn squared_errors_are_the_plain_ones() {
    for seed in 0..20 {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let shape = shape(&mut generator, 1);
        let ensemble = Ensemble::new(shape, weights(shape.layout(), &mut generator), Precision::Bf16);
        let rows = generator.random_range(1..300);
        let observations = tensor(&mut generator, &[rows, shape.observation_dim]);
        let actions = tensor(&mut generator, &[rows, shape.action_dim]);
        let targets = tensor(&mut generator, &[rows]);
        for factor in [1.0, -2.5] {
            let fast = (ensemble.squared_error(&observations, &actions, &targets).unwrap() * factor).unwrap();
            let plain = (ensemble.plain_squared_error(&observations, &actions, &targets).unwrap() * factor).unwrap();
            close("loss", &fast, &plain);
            let gradient = |loss: Tensor| ensemble.weights().gradient(&loss.backward().unwrap()).unwrap();
            let expected = gradient(plain);
            close(&format!("{shape:?}, {rows} rows, times {factor}"), &gradient(fast), &expected);
        }
    }
}

#[test]
fn action_gradients_are_the_plain_ones() {
    for seed in 0..20 {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let shape = shape(&mut generator, 1);
        let weights = weights(shape.layout(), &mut generator).copy().unwrap();
        let ensemble = Ensemble::new(shape, weights, Precision::F32);
        let (states, repeat) = (generator.random_range(1..200), generator.random_range(1..4));
        let observations = tensor(&mut generator, &[states, shape.observation_dim]);
        let actions = tensor(&mut generator, &[states * repeat, shape.action_dim]);
        let fast = ensemble.action_gradients(&observations, &actions).unwrap();
        let plain = ensemble.plain_action_gradients(&observations, &actions).unwrap();
        close(&format!("{shape:?}, {states} × {repeat}"), &fast, &plain);
    }
}

fn noise_predictor(generator: &mut ChaCha8Rng) -> NoisePredictor {
    let EnsembleShape { observation_dim, action_dim, hidden, .. } = shape(generator, 1);
    let shape = NoiseShape { observation_dim, action_dim, hidden, diffusion_steps: generator.random_range(1..7) };
    NoisePredictor::new(shape, weights(shape.layout(), generator), Precision::F32)
}

#[test]
fn noise_predictors_give_the_plain_values_and_gradients() {
    for seed in 0..20 {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let actor = noise_predictor(&mut generator);
        let NoiseShape { observation_dim, action_dim, diffusion_steps, .. } = actor.shape();
        let rows = generator.random_range(1..300);
        let observations = tensor(&mut generator, &[rows, observation_dim]);
        let [actions, epsilon] = [0; 2].map(|_| tensor(&mut generator, &[rows, action_dim]));
        let t: Vec<u32> = (0..rows).map(|_| generator.random_range(1..=diffusion_steps as u32)).collect();
        let t = Tensor::from_vec(t, rows, &Device::Cpu).unwrap();
        let fast = actor.predict(&observations, &actions, &t).unwrap();
        let plain = actor.plain_predict(&observations, &actions, &t).unwrap();
        close("prediction", &fast, &plain);
        close("frozen prediction", &actor.frozen().predict(&observations, &actions, &t).unwrap(), &plain);
        let gradient = |predicted: Tensor| {
            let loss = (predicted - &epsilon).unwrap().sqr().unwrap().mean_all().unwrap();
            actor.weights().gradient(&loss.backward().unwrap()).unwrap().copy().unwrap()
        };
        let expected = gradient(plain);
        close(&format!("{:?}, {rows} rows", actor.shape()), &gradient(fast), &expected);
    }
}

#[test]
fn the_sampler_draws_what_the_plain_one_draws() {
    for seed in 0..10 {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let actor = noise_predictor(&mut generator);
        let NoiseShape { observation_dim, action_dim, diffusion_steps, .. } = actor.shape();
        let (states, repeat) = (generator.random_range(1..100), generator.random_range(1..12));
        let observations = tensor(&mut generator, &[states, observation_dim]);
        let noise = tensor(&mut generator, &[diffusion_steps, states * repeat, action_dim]);
        let fast = actor.sample(&observations, &noise).unwrap();
        close(&format!("{:?}", actor.shape()), &fast, &actor.plain_sample(&observations, &noise).unwrap());
    }
}

#[test]
fn rounding_changes_little_and_follows_the_weights() {
    let mut generator = ChaCha8Rng::seed_from_u64(3);
    let shape = EnsembleShape { members: 3, observation_dim: 11, action_dim: 3, hidden: 64, outputs: 1 };
    let weights = weights(shape.layout(), &mut generator);
    let exact = Ensemble::new(shape, weights.copy().unwrap(), Precision::F32);
    let mut rounded = Ensemble::new(shape, weights.copy().unwrap(), Precision::Bf16);
    let (observations, actions) = (tensor(&mut generator, &[50, 11]), tensor(&mut generator, &[50, 3]));
    let values = |ensemble: &Ensemble| numbers(&ensemble.values(&observations, &actions).unwrap());
    let (a, b) = (values(&exact), values(&rounded));
    let difference = a.iter().zip(&b).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
    let rounds = Precision::Bf16.is_available() && has_fast_body(&Device::Cpu);
    assert_eq!(difference > 0.0, rounds, "rounding is seen where there is any");
    assert!(difference < 0.02, "values differ by {difference}");
    rounded.weights_mut().change(|values| modify(values, |x| x.fill(0.0))).unwrap();
    assert!(values(&rounded).iter().all(|q| *q == 0.0), "kernels rounded before the change were used");
}

#[test]
fn shapes_that_do_not_fit_are_errors() {
    let mut generator = ChaCha8Rng::seed_from_u64(0);
    let shape = EnsembleShape { members: 2, observation_dim: 4, action_dim: 2, hidden: 8, outputs: 1 };
    let ensemble = Ensemble::new(shape, weights(shape.layout(), &mut generator), Precision::F32);
    for (observations, actions) in [([5, 4], [5, 3]), ([5, 3], [5, 2]), ([5, 4], [7, 2]), ([5, 4], [0, 2])] {
        let (observations, actions) = (tensor(&mut generator, &observations), tensor(&mut generator, &actions));
        assert!(ensemble.values(&observations, &actions).is_err(), "{observations} {actions}");
    }
}
