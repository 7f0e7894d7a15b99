//! Tests: every fast implementation against plain operations, and gradients against finite
//! differences, at random shapes.

use crate::adam::{Adam, AdamStep};
use crate::diffusion::noise_predictor::NoisePredictor;
use crate::diffusion::schedule::Reverse;
use crate::ensemble::Ensemble;
use crate::gradients::gradient::Gradients;
use crate::layers::config::{InitScheme, MlpConfig, NormEpsilon};
use crate::shape::{EnsembleShape, NoiseShape};
use crate::slices::{has_fast_implementation, modify, plainly};
use crate::statistics::mean_and_variance;
use crate::testing::{
    assert_close, assert_within, check_gradient, gradient, loss, numbers, random, tensor, weights,
};
use crate::weighted::Weighted;
use crate::weights::Weights;
use candle_core::{Device, Result, Tensor, Var};
use quad_kernels::Precision;
use quad_kernels::activation::Activation;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ACTIVATIONS: [Activation; 5] =
    [Activation::Mish, Activation::Relu, Activation::Silu, Activation::Tanh, Activation::Gelu];
const REVERSES: [Reverse; 4] =
    [Reverse::ClipClean, Reverse::Posterior, Reverse::ClipSample, Reverse::Cosine];

fn one_of<T: Copy>(generator: &mut ChaCha8Rng, values: &[T]) -> T {
    values[generator.random_range(0..values.len())]
}

fn layers(generator: &mut ChaCha8Rng) -> MlpConfig {
    let initial = [InitScheme::Xavier, InitScheme::Orthogonal, InitScheme::Torch];
    MlpConfig {
        // Widths that AVX-512 supports, and others.
        hidden: (0..generator.random_range(1..5))
            .map(|_| one_of(generator, &[13, 24, 32, 64]))
            .collect(),
        activation: one_of(generator, &ACTIVATIONS),
        norm: generator.random(),
        norm_after: generator.random(),
        norm_epsilon: one_of(generator, &[NormEpsilon::Flax, NormEpsilon::Torch]),
        initial: one_of(generator, &initial),
    }
}

fn shape(generator: &mut ChaCha8Rng) -> EnsembleShape {
    let dims = (generator.random_range(1..20), generator.random_range(0..8));
    let (members, outputs) = (generator.random_range(1..5), generator.random_range(1..40));
    EnsembleShape::critics(members, dims, &layers(generator)).with_outputs(outputs)
}

fn ensemble(generator: &mut ChaCha8Rng, shape: &EnsembleShape) -> Ensemble {
    Ensemble::new(shape.clone(), weights(shape.layout(), generator), Precision::F32)
}

fn noise_predictor(
    generator: &mut ChaCha8Rng,
    layers: MlpConfig,
    diffusion_steps: usize,
) -> NoisePredictor {
    let observation_dim = generator.random_range(1..20);
    let (action_dim, reverse) = (generator.random_range(1..8), one_of(generator, &REVERSES));
    let shape = NoiseShape { observation_dim, action_dim, layers, diffusion_steps, reverse };
    NoisePredictor::new(shape.clone(), weights(shape.layout(), generator), Precision::F32)
}

#[test]
fn gradients_match_finite_differences() -> Result<()> {
    let norms =
        [(false, false, 1), (false, false, 3), (true, false, 1), (true, false, 2), (true, true, 2)];
    let cases = ACTIVATIONS.into_iter().flat_map(|f| norms.map(|norm| (f, norm)));
    for (activation, (norm, norm_after, depth)) in cases {
        let generator = &mut ChaCha8Rng::seed_from_u64(depth as u64);
        let mut layers = MlpConfig::mish(&[24, 32, 7][..depth]);
        (layers.activation, layers.norm, layers.norm_after) = (activation, norm, norm_after);
        let shape = EnsembleShape::critics(2, (4, 3), &layers).with_outputs(2);
        let networks = ensemble(generator, &shape);
        let s = Var::from_tensor(&tensor(generator, (5, 4)))?;
        let a = Var::from_tensor(&tensor(generator, (10, 3)))?;
        let gradients = Gradients::of(&loss(&networks.outputs(&s, &a)?)?)?;
        let of_w = gradients.with_respect_to(networks.weights())?;
        let (of_s, of_a) = (gradients.store.get(&s).unwrap(), gradients.store.get(&a).unwrap());
        let (w, s, a) = (networks.weights().values().detach(), s.detach(), a.detach());
        let outputs = |w: &Tensor, s: &Tensor, a: &Tensor| {
            let weights = Weights::constant(shape.layout(), w.clone());
            Ensemble::new(shape.clone(), weights, Precision::F32).outputs(s, a)
        };
        let what = |of: &str| format!("{of}: {layers:?}");
        let check = |of, at, gradient, outputs: &dyn Fn(&Tensor) -> Result<Tensor>| {
            check_gradient((&what(of), 1e-3, 0.02), (at, gradient), outputs)
        };
        check("weights", &w, &of_w, &|w| outputs(w, &s, &a))?;
        check("observations", &s, of_s, &|s| outputs(&w, s, &a))?;
        check("actions", &a, of_a, &|a| outputs(&w, &s, a))?;

        // Many steps: clipping leaves the first ones no gradient.
        let predictor = noise_predictor(generator, layers.clone(), 8);
        let shape = predictor.shape();
        let s = tensor(generator, (60, shape.observation_dim));
        let z = tensor(generator, (8, 60, shape.action_dim));
        let of_w = gradient(&predictor.sample_with_gradient(&s, &z)?, predictor.weights())?;
        let w = predictor.weights().values().detach();
        // Clipping has corners, hence the tolerance.
        check_gradient((&what("sampler"), 2e-5, 0.1), (&w, &of_w), |w| {
            let weights = Weights::constant(shape.layout(), w.clone());
            NoisePredictor::new(shape.clone(), weights, Precision::F32).sample_with_gradient(&s, &z)
        })?;
    }
    Ok(())
}

#[test]
fn ensembles_match_plain_operations() -> Result<()> {
    for seed in 0..30 {
        let generator = &mut ChaCha8Rng::seed_from_u64(seed);
        let shape = shape(generator);
        let networks = ensemble(generator, &shape);
        let (states, repeat) = (generator.random_range(1..200), generator.random_range(1..4));
        let rows = if shape.action_dim == 0 { states } else { states * repeat };
        let s = tensor(generator, (states, shape.observation_dim));
        let a = Var::from_tensor(&tensor(generator, (rows, shape.action_dim)))?;
        let close = |of: &str, found: &Tensor, expected: &Tensor| {
            assert_close(&format!("{of}: {shape:?}, {rows} rows of {states}"), found, expected);
        };
        let (fast, plain) = (networks.outputs(&s, &a)?, plainly(|| networks.outputs(&s, &a))?);
        close("outputs", &fast, &plain);
        close("constants", &networks.detach().outputs(&s, &a.detach())?, &plain);
        let gradients = |loss: &Tensor| {
            let gradients = Gradients::of(loss)?;
            let of_weights = gradients.with_respect_to(networks.weights())?.copy()?;
            Result::Ok((of_weights, gradients.store.get(&a).cloned()))
        };
        let (fast, plain) = (gradients(&loss(&fast)?)?, gradients(&loss(&plain)?)?);
        close("gradient of weights", &fast.0, &plain.0);
        let once = loss(&networks.outputs(&s, &a)?)?;
        let twice = gradients(&(once + loss(&networks.outputs(&s, &a)?)?)?)?;
        close("gradient of two passes", &twice.0, &(fast.0 * 2.0)?);
        if shape.action_dim > 0 {
            close("gradient of actions", &fast.1.unwrap(), &plain.1.unwrap());
            let critics = ensemble(generator, &shape.clone().with_outputs(1));
            let gradients = || critics.action_gradients(&s, &a);
            close("action gradients", &gradients()?, &plainly(gradients)?);
        }
    }
    Ok(())
}

#[test]
fn a_backward_pass_overwrites_the_gradient_of_the_last() -> Result<()> {
    let generator = &mut ChaCha8Rng::seed_from_u64(0);
    let shape = EnsembleShape { action_dim: 2, ..shape(generator) };
    let networks = ensemble(generator, &shape);
    let (s, a) = (tensor(generator, (9, shape.observation_dim)), tensor(generator, (9, 2)));
    let first = gradient(&networks.outputs(&s, &a)?, networks.weights())?;
    let overwritten = Gradients::of(&loss(&networks.outputs(&s, &a)?)?)?;
    let second = gradient(&networks.outputs(&s, &a)?, networks.weights())?;
    assert_eq!(numbers(&first), numbers(&second));
    if has_fast_implementation(&Device::Cpu) {
        assert!(overwritten.with_respect_to(networks.weights()).is_err());
        let outside = loss(&networks.outputs(&s, &a)?)?.backward();
        assert!(outside.is_err(), "a backward pass outside of `Gradients::of`");
    }
    Ok(())
}

#[test]
fn noise_predictors_match_plain_operations() -> Result<()> {
    for seed in 0..20 {
        let generator = &mut ChaCha8Rng::seed_from_u64(seed);
        let (layers, steps) = (layers(generator), generator.random_range(1..7));
        let actor = noise_predictor(generator, layers, steps);
        let (rows, action_dim) = (generator.random_range(1..300), actor.shape().action_dim);
        let s = tensor(generator, (rows, actor.shape().observation_dim));
        let a = tensor(generator, (rows, action_dim));
        let t = (0..rows).map(|_| generator.random_range(1..=steps as u32));
        let t = Tensor::from_iter(t, &Device::Cpu)?;
        let (fast, plain) = (actor.predict(&s, &a, &t)?, plainly(|| actor.predict(&s, &a, &t))?);
        assert_close("predictions", &fast, &plain);
        assert_close("constants", &actor.detach().predict(&s, &a, &t)?, &plain);
        let of_fast = gradient(&fast, actor.weights())?;
        let of_plain = gradient(&plain, actor.weights())?;
        assert_close(&format!("{:?}, {rows} rows", actor.shape()), &of_fast, &of_plain);

        let repeat = generator.random_range(1..12);
        let noise = tensor(generator, (steps, rows * repeat, action_dim));
        let fast = actor.sample(&s, &noise)?;
        // Each denoising step magnifies rounding.
        assert_within(1e-4, "samples", &fast, &plainly(|| actor.sample(&s, &noise))?);
        assert_within(1e-4, "samples", &fast, &actor.sample_with_gradient(&s, &noise)?);
    }
    Ok(())
}

#[test]
fn adam_ema_and_statistics_match_plain_operations() -> Result<()> {
    let generator = &mut ChaCha8Rng::seed_from_u64(1);
    for (clip, decay) in [(None, 0.0), (Some(0.3), 0.0), (Some(1e6), 0.0), (None, 0.5)] {
        // Several chunks, and no whole number of registers.
        let layout = EnsembleShape::critics(3, (11, 3), &MlpConfig::mish(&[77, 78])).layout();
        let mut fast = weights(layout.clone(), generator);
        let mut plain = Weights::trainable(layout, fast.values())?;
        let (mut target, mut plain_target) = (fast.copy()?, fast.copy()?);
        let (mut adam, mut plain_adam) = (Adam::new(&fast, decay)?, Adam::new(&plain, decay)?);
        for count in 1..4 {
            let gradient = tensor(generator, fast.values().shape());
            let step = AdamStep { rate: 0.01, clip, count };
            adam.set_step(step)?;
            plain_adam.set_step(step)?;
            let size = adam.apply(&mut fast, &gradient)?;
            let plain_size = plainly(|| plain_adam.apply(&mut plain, &gradient))?;
            assert_close("norm", &size, &plain_size);
            assert_close("moments", &adam.moments, &plain_adam.moments);
            assert_close("weights", fast.values(), plain.values());
        }
        target.soft_update(&fast, 0.25)?;
        plainly(|| plain_target.soft_update(&fast, 0.25))?;
        assert_close("EMA", target.values(), plain_target.values());
    }
    for dims in [vec![1, 4], vec![3, 7], vec![10, 5, 3]] {
        let x = random(dims, 2);
        let (fast, plain) = (mean_and_variance(&x)?, plainly(|| mean_and_variance(&x))?);
        assert_close("mean", &fast.0, &plain.0);
        assert_close("variance", &fast.1, &plain.1);
    }
    Ok(())
}

#[test]
fn bf16_is_close_to_f32_and_follows_the_weights() -> Result<()> {
    let generator = &mut ChaCha8Rng::seed_from_u64(3);
    let shape = EnsembleShape::critics(3, (11, 3), &MlpConfig::mish(&[64; 3]));
    let weights = ensemble(generator, &shape).weights().values().detach();
    let (s, a) = (tensor(generator, (192, 11)), Var::from_tensor(&tensor(generator, (192, 3)))?);
    let network = |precision| {
        let weights = Weights::trainable(shape.layout(), &weights)?;
        Result::Ok(Ensemble::new(shape.clone(), weights, precision))
    };
    let results = |precision| {
        let network = network(precision)?;
        let values = network.values(&s, &a)?;
        let gradients = Gradients::of(&loss(&values)?)?;
        let constants = network.detach().values(&s, &a.detach())?;
        let weights_gradient = gradients.with_respect_to(network.weights())?.copy()?;
        let actions_gradient = gradients.store.get(&a).unwrap().clone();
        let by_members = network.action_gradients(&s, &a)?;
        Result::Ok([values, constants, weights_gradient, actions_gradient, by_members])
    };
    let rounds = Precision::Bf16.is_available() && has_fast_implementation(&Device::Cpu);
    for (x, y) in results(Precision::F32)?.iter().zip(&results(Precision::Bf16)?) {
        let size = |x: &Tensor| Result::Ok(x.sqr()?.sum_all()?.to_scalar::<f32>()?.sqrt());
        let distance = size(&(x - y)?)? / size(x)?;
        assert_eq!(distance > 0.0, rounds);
        assert!(distance < 0.01, "{distance}");
    }
    let mut changed = network(Precision::Bf16)?.detach();
    changed.values(&s, &a.detach())?;
    changed.weights_mut().change(|values| modify(values, |x| x.fill(0.0)))?;
    let values = numbers(&changed.values(&s, &a.detach())?);
    assert!(values.iter().all(|q| *q == 0.0), "old kernels were used");
    Ok(())
}

#[test]
fn wrong_shapes_are_errors() {
    let generator = &mut ChaCha8Rng::seed_from_u64(0);
    let shape = EnsembleShape::critics(2, (4, 2), &MlpConfig::mish(&[8]));
    let ensemble = ensemble(generator, &shape);
    for [n, o, rows, a] in [[5, 4, 5, 3], [5, 3, 5, 2], [5, 4, 7, 2], [5, 4, 0, 2]] {
        let values = ensemble.values(&random((n, o), 1), &random((rows, a), 2));
        assert!(values.is_err(), "{n} × {o} and {rows} × {a}");
    }
}
