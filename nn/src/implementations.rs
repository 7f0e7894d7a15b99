//! Tests: gradients against finite differences for every shape of network, and each fast
//! implementation against the plain one at random shapes.

use crate::adam::{Adam, AdamStep};
use crate::diffusion::noise_predictor::NoisePredictor;
use crate::diffusion::schedule::Reverse;
use crate::ensemble::Ensemble;
use crate::gradients::gradient::Gradients;
use crate::layers::config::{Epsilon, Initial, MlpConfig};
use crate::precision::Precision;
use crate::shape::{EnsembleShape, NoiseShape};
use crate::slices::{has_fast_implementation, modify, plainly};
use crate::statistics::mean_and_variance;
use crate::weighted::Weighted;
use crate::weights::{Layout, Weights};
use candle_core::{Device, Tensor, Var};
use quad_kernels::activation::Activation;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ACTIVATIONS: [Activation; 5] =
    [Activation::Mish, Activation::Relu, Activation::Silu, Activation::Tanh, Activation::Gelu];

fn tensor(generator: &mut ChaCha8Rng, shape: &[usize]) -> Tensor {
    let numbers: Vec<f32> =
        (0..shape.iter().product()).map(|_| generator.random_range(-1.0..1.0)).collect();
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

fn layers(generator: &mut ChaCha8Rng) -> MlpConfig {
    // Widths that AVX-512 serves, and others.
    let widths = [13, 24, 32, 64];
    MlpConfig {
        hidden: (0..generator.random_range(1..5))
            .map(|_| widths[generator.random_range(0..4)])
            .collect(),
        activation: ACTIVATIONS[generator.random_range(0..5)],
        norm: generator.random(),
        norm_after: generator.random(),
        norm_epsilon: [Epsilon::Flax, Epsilon::Torch][generator.random_range(0..2)],
        initial: [Initial::Xavier, Initial::Orthogonal, Initial::Torch]
            [generator.random_range(0..3)],
    }
}

fn shape(generator: &mut ChaCha8Rng) -> EnsembleShape {
    EnsembleShape {
        members: generator.random_range(1..5),
        observation_dim: generator.random_range(1..20),
        action_dim: generator.random_range(0..8),
        layers: layers(generator),
        outputs: generator.random_range(1..40),
    }
}

fn ensemble(generator: &mut ChaCha8Rng, shape: EnsembleShape) -> Ensemble {
    let weights = weights(shape.layout(), generator);
    Ensemble::new(shape, weights, Precision::F32)
}

fn noise_predictor(
    generator: &mut ChaCha8Rng,
    layers: MlpConfig,
    diffusion_steps: usize,
) -> NoisePredictor {
    let (observation_dim, action_dim) =
        (generator.random_range(1..20), generator.random_range(1..8));
    let reverse =
        [Reverse::ClipClean, Reverse::Posterior, Reverse::ClipSample][generator.random_range(0..3)];
    let shape = NoiseShape { observation_dim, action_dim, layers, diffusion_steps, reverse };
    let weights = weights(shape.layout(), generator);
    NoisePredictor::new(shape, weights, Precision::F32)
}

/// Checks the gradient of a loss by finite differences: along the gradient, and along a random
/// direction.
fn check_gradient(
    (what, step, room): (&str, f64, f64),
    generator: &mut ChaCha8Rng,
    (at, gradient): (&Tensor, &Tensor),
    loss: impl Fn(&Tensor) -> Tensor,
) {
    let value = |at: Tensor| f64::from(loss(&at).to_scalar::<f32>().unwrap());
    let size = gradient.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap().sqrt();
    assert!(size > 1e-3, "{what}: no gradient");
    let random = tensor(generator, at.dims());
    for direction in [gradient.detach(), random] {
        let length = direction.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap().sqrt();
        let moved = (direction * (step / f64::from(length))).unwrap();
        let expected = (gradient * &moved).unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap();
        let found = (value((at + &moved).unwrap()) - value((at - &moved).unwrap())) / 2.0;
        let difference = (found - f64::from(expected)).abs();
        assert!(difference < room * f64::from(size) * step, "{what}: {found} for {expected}");
    }
}

/// A loss that every output has another part in.
fn loss(outputs: &Tensor) -> Tensor {
    let factors =
        Tensor::arange(0f32, outputs.elem_count() as f32, &Device::Cpu).unwrap().sin().unwrap();
    (outputs.flatten_all().unwrap() * factors).unwrap().sqr().unwrap().sum_all().unwrap()
}

#[test]
fn gradients_are_what_finite_differences_say() {
    let norms =
        [(false, false, 1), (false, false, 3), (true, false, 1), (true, false, 2), (true, true, 2)];
    for (activation, (norm, norm_after, depth)) in
        ACTIVATIONS.into_iter().flat_map(|f| norms.map(|n| (f, n)))
    {
        let mut generator = ChaCha8Rng::seed_from_u64(depth as u64);
        let layers =
            MlpConfig { activation, norm, norm_after, ..MlpConfig::mish(&[24, 32, 7][..depth]) };
        let shape = EnsembleShape {
            members: 2,
            observation_dim: 4,
            action_dim: 3,
            layers: layers.clone(),
            outputs: 2,
        };
        let networks = ensemble(&mut generator, shape.clone());
        let observations = Var::from_tensor(&tensor(&mut generator, &[5, 4])).unwrap();
        let actions = Var::from_tensor(&tensor(&mut generator, &[10, 3])).unwrap();
        let what = format!("{layers:?}");
        let at = |weights: &Tensor, s: &Tensor, a: &Tensor| {
            let weights = Weights::constant(shape.layout(), weights.clone());
            loss(&Ensemble::new(shape.clone(), weights, Precision::F32).outputs(s, a).unwrap())
        };
        let gradients =
            Gradients::of(&loss(&networks.outputs(&observations, &actions).unwrap())).unwrap();
        let of_weights = gradients.with_respect_to(networks.weights()).unwrap();
        let (w, s, a) =
            (networks.weights().values().detach(), observations.detach(), actions.detach());
        check_gradient(
            (&format!("{what}: weights"), 1e-3, 0.02),
            &mut generator,
            (&w, &of_weights),
            |w| at(w, &s, &a),
        );
        let of_s = gradients.store.get(&observations).unwrap();
        check_gradient(
            (&format!("{what}: observations"), 1e-3, 0.02),
            &mut generator,
            (&s, of_s),
            |s| at(&w, s, &a),
        );
        let of_a = gradients.store.get(&actions).unwrap();
        check_gradient(
            (&format!("{what}: actions"), 1e-3, 0.02),
            &mut generator,
            (&a, of_a),
            |a| at(&w, &s, a),
        );

        // Many steps: clipping leaves the first ones no gradient.
        let predictor = noise_predictor(&mut generator, layers, 8);
        let NoiseShape { observation_dim, action_dim, diffusion_steps: steps, .. } =
            *predictor.shape();
        let (s, z) = (
            tensor(&mut generator, &[60, observation_dim]),
            tensor(&mut generator, &[steps, 60, action_dim]),
        );
        let at = |weights: &Tensor| {
            let weights = Weights::constant(predictor.shape().layout(), weights.clone());
            let predictor = NoisePredictor::new(predictor.shape().clone(), weights, Precision::F32);
            loss(&predictor.sample_with_gradient(&s, &z).unwrap())
        };
        let gradients =
            Gradients::of(&loss(&predictor.sample_with_gradient(&s, &z).unwrap())).unwrap();
        let of_weights = gradients.with_respect_to(predictor.weights()).unwrap();
        let w = predictor.weights().values().detach();
        // Clipping has corners, for which there is more room.
        check_gradient(
            (&format!("{what}: sampler"), 1e-4, 0.1),
            &mut generator,
            (&w, &of_weights),
            at,
        );
    }
}

#[test]
fn ensembles_give_the_plain_values_and_gradients() {
    for seed in 0..30 {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let shape = shape(&mut generator);
        let networks = ensemble(&mut generator, shape.clone());
        let (states, repeat) = (generator.random_range(1..200), generator.random_range(1..4));
        let repeat = if shape.action_dim == 0 { 1 } else { repeat };
        let observations = tensor(&mut generator, &[states, shape.observation_dim]);
        let actions =
            Var::from_tensor(&tensor(&mut generator, &[states * repeat, shape.action_dim]))
                .unwrap();
        let what = format!("{shape:?}, {states} × {repeat}");
        let plain = plainly(|| networks.outputs(&observations, &actions)).unwrap();
        let constant = networks.detach().outputs(&observations, &actions.detach()).unwrap();
        close(&what, &constant, &plain);
        let fast = networks.outputs(&observations, &actions).unwrap();
        close(&what, &fast, &plain);
        let gradients = |loss: Tensor| {
            let gradients = Gradients::of(&loss).unwrap();
            let of_actions = if shape.action_dim > 0 {
                gradients.store.get(&actions).unwrap().clone()
            } else {
                loss
            };
            (gradients.with_respect_to(networks.weights()).unwrap().copy().unwrap(), of_actions)
        };
        let (fast, plain) = (gradients(loss(&fast)), gradients(loss(&plain)));
        close(&format!("weights of {what}"), &fast.0, &plain.0);
        close(&format!("actions of {what}"), &fast.1, &plain.1);
        // A loss that has the network in it twice.
        let [once, again] =
            [0; 2].map(|_| loss(&networks.outputs(&observations, &actions).unwrap()));
        close("twice", &gradients((once + again).unwrap()).0, &(fast.0 * 2.0).unwrap());

        let critics = ensemble(&mut generator, EnsembleShape { outputs: 1, ..shape.clone() });
        let gradients = || critics.action_gradients(&observations, &actions).unwrap();
        if shape.action_dim > 0 {
            close(&format!("action gradients of {what}"), &gradients(), &plainly(gradients));
        }
    }
}

#[test]
fn a_gradient_that_is_not_taken_is_not_added_to_the_next() {
    let mut generator = ChaCha8Rng::seed_from_u64(0);
    let shape = EnsembleShape { action_dim: 2, ..shape(&mut generator) };
    let networks = ensemble(&mut generator, shape.clone());
    let (s, a) =
        (tensor(&mut generator, &[9, shape.observation_dim]), tensor(&mut generator, &[9, 2]));
    let pass = || Gradients::of(&loss(&networks.outputs(&s, &a).unwrap())).unwrap();
    let first = pass().with_respect_to(networks.weights()).unwrap().copy().unwrap();
    let not_taken = pass();
    let second = pass().with_respect_to(networks.weights()).unwrap();
    assert_eq!(numbers(&first), numbers(&second));
    if has_fast_implementation(&Device::Cpu) {
        assert!(
            not_taken.with_respect_to(networks.weights()).is_err(),
            "another pass has overwritten it"
        );
        assert!(
            loss(&networks.outputs(&s, &a).unwrap()).backward().is_err(),
            "it would be left nowhere"
        );
    }
}

#[test]
fn noise_predictors_give_the_plain_values_and_samples() {
    for seed in 0..20 {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        let layers = layers(&mut generator);
        let steps = generator.random_range(1..7);
        let actor = noise_predictor(&mut generator, layers, steps);
        let NoiseShape { observation_dim, action_dim, diffusion_steps, .. } = *actor.shape();
        let rows = generator.random_range(1..300);
        let observations = tensor(&mut generator, &[rows, observation_dim]);
        let actions = tensor(&mut generator, &[rows, action_dim]);
        let t: Vec<u32> =
            (0..rows).map(|_| generator.random_range(1..=diffusion_steps as u32)).collect();
        let t = Tensor::from_vec(t, rows, &Device::Cpu).unwrap();
        let fast = actor.predict(&observations, &actions, &t).unwrap();
        let plain = plainly(|| actor.predict(&observations, &actions, &t)).unwrap();
        close("prediction", &fast, &plain);
        close(
            "of constants",
            &actor.detach().predict(&observations, &actions, &t).unwrap(),
            &plain,
        );
        let gradient = |predicted: &Tensor| {
            Gradients::of(&loss(predicted))
                .unwrap()
                .with_respect_to(actor.weights())
                .unwrap()
                .copy()
                .unwrap()
        };
        close(&format!("{:?}, {rows} rows", actor.shape()), &gradient(&fast), &gradient(&plain));

        let repeat = generator.random_range(1..12);
        let noise = tensor(&mut generator, &[diffusion_steps, rows * repeat, action_dim]);
        let fast = actor.sample(&observations, &noise).unwrap();
        close("samples", &fast, &plainly(|| actor.sample(&observations, &noise)).unwrap());
        close("samples", &fast, &actor.sample_with_gradient(&observations, &noise).unwrap());
    }
}

#[test]
fn adam_the_ema_and_statistics_do_what_plain_operations_do() {
    let mut generator = ChaCha8Rng::seed_from_u64(1);
    for (clip, decay) in [(None, 0.0), (Some(0.3), 0.0), (Some(1e6), 0.0), (None, 0.5)] {
        // Enough numbers for several chunks, and no whole number of registers.
        let shape = EnsembleShape {
            members: 3,
            layers: MlpConfig::mish(&[77, 78]),
            ..shape(&mut generator)
        };
        let mut fast = weights(shape.layout(), &mut generator);
        let mut plain = Weights::trainable(shape.layout(), fast.values()).unwrap();
        let [mut fast_adam, mut plain_adam] =
            [&fast, &plain].map(|weights| Adam::new(weights, decay).unwrap());
        let [mut target, mut plain_target] = [(); 2].map(|()| fast.copy().unwrap());
        for count in 1..4 {
            let gradient = tensor(&mut generator, &[fast.values().elem_count()]);
            let step = AdamStep { rate: 0.01, clip, count };
            let size = fast_adam.apply(&mut fast, &gradient, step).unwrap();
            close(
                "norm",
                &size,
                &plainly(|| plain_adam.apply(&mut plain, &gradient, step)).unwrap(),
            );
            close("moments", &fast_adam.moments, &plain_adam.moments);
            close("weights", fast.values(), plain.values());
        }
        target.ema_update(&fast, 0.25).unwrap();
        plainly(|| plain_target.ema_update(&fast, 0.25)).unwrap();
        close("EMA", target.values(), plain_target.values());
    }
    for dims in [vec![1, 4], vec![3, 7], vec![10, 5, 3]] {
        let x = tensor(&mut generator, &dims);
        let statistics = || <[Tensor; 2]>::from(mean_and_variance(&x).unwrap());
        statistics()
            .iter()
            .zip(plainly(statistics))
            .for_each(|(fast, plain)| close("statistics", fast, &plain));
    }
}

#[test]
fn rounding_changes_little_and_follows_the_weights() {
    let mut generator = ChaCha8Rng::seed_from_u64(3);
    let layers = MlpConfig::mish(&[64, 64, 64]);
    let shape =
        EnsembleShape { members: 3, observation_dim: 11, action_dim: 3, layers, outputs: 1 };
    let weights = weights(shape.layout(), &mut generator);
    let exact = Ensemble::new(shape.clone(), weights.copy().unwrap(), Precision::F32);
    let mut rounded = Ensemble::new(shape, weights.copy().unwrap(), Precision::Bf16);
    let (observations, actions) =
        (tensor(&mut generator, &[50, 11]), tensor(&mut generator, &[50, 3]));
    let values = |ensemble: &Ensemble| numbers(&ensemble.values(&observations, &actions).unwrap());
    let (a, b) = (values(&exact), values(&rounded));
    let difference = a.iter().zip(&b).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
    let rounds = Precision::Bf16.is_available() && has_fast_implementation(&Device::Cpu);
    assert_eq!(difference > 0.0, rounds, "rounding is seen where there is any");
    assert!(difference < 0.02, "values differ by {difference}");
    assert_eq!(values(&rounded.detach()), b, "constant weights are rounded alike");
    rounded.weights_mut().change(|values| modify(values, |x| x.fill(0.0))).unwrap();
    assert!(
        values(&rounded).iter().all(|q| *q == 0.0),
        "kernels rounded before the change were used"
    );
}

#[test]
fn shapes_that_do_not_fit_are_errors() {
    let mut generator = ChaCha8Rng::seed_from_u64(0);
    let layers = MlpConfig::mish(&[8]);
    let shape = EnsembleShape { members: 2, observation_dim: 4, action_dim: 2, layers, outputs: 1 };
    let ensemble = ensemble(&mut generator, shape);
    for (observations, actions) in
        [([5, 4], [5, 3]), ([5, 3], [5, 2]), ([5, 4], [7, 2]), ([5, 4], [0, 2])]
    {
        let (observations, actions) =
            (tensor(&mut generator, &observations), tensor(&mut generator, &actions));
        assert!(ensemble.values(&observations, &actions).is_err(), "{observations} {actions}");
    }
}
