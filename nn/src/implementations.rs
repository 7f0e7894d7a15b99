//! Tests: every fast implementation against plain operations, and gradients against finite
//! differences, at random shapes.

use crate::adam::{Adam, AdamStep};
use crate::diffusion::noise_predictor::NoisePredictor;
use crate::diffusion::schedule::Reverse::{self, ClipClean, ClipSample, Cosine, Posterior};
use crate::ensemble::Ensemble;
use crate::gradients::gradient::Gradients;
use crate::layers::config::InitScheme::{Orthogonal, Torch, Xavier};
use crate::layers::config::{MlpConfig, NormEpsilon};
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
use quad_kernels::activation::Activation::{self, Gelu, Mish, Relu, Silu, Tanh};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ACTIVATIONS: [Activation; 5] = [Mish, Relu, Silu, Tanh, Gelu];
const REVERSES: [Reverse; 4] = [ClipClean, Posterior, ClipSample, Cosine];

fn choose<T: Copy>(generator: &mut ChaCha8Rng, values: &[T]) -> T {
    values[generator.random_range(0..values.len())]
}

fn layers(generator: &mut ChaCha8Rng) -> MlpConfig {
    // Widths that AVX-512 supports, and others.
    let widths = [13, 24, 32, 64];
    let count = generator.random_range(1..5);
    MlpConfig {
        hidden: (0..count).map(|_| choose(generator, &widths)).collect(),
        activation: choose(generator, &ACTIVATIONS),
        norm: generator.random(),
        norm_after: generator.random(),
        norm_epsilon: choose(generator, &[NormEpsilon::Flax, NormEpsilon::Torch]),
        initial: choose(generator, &[Xavier, Orthogonal, Torch]),
    }
}

fn shape(generator: &mut ChaCha8Rng) -> EnsembleShape {
    let dims = (generator.random_range(1..20), generator.random_range(0..8));
    let (members, outputs) = (generator.random_range(1..5), generator.random_range(1..40));
    EnsembleShape::critics(members, dims, &layers(generator)).with_outputs(outputs)
}

fn ensemble(generator: &mut ChaCha8Rng, shape: &EnsembleShape) -> Ensemble {
    let weights = weights(shape.layout(), generator);
    Ensemble::new(shape.clone(), weights, Precision::F32)
}

fn noise_predictor(generator: &mut ChaCha8Rng, layers: MlpConfig, steps: usize) -> NoisePredictor {
    let shape = NoiseShape {
        observation_dim: generator.random_range(1..20),
        action_dim: generator.random_range(1..8),
        layers,
        diffusion_steps: steps,
        reverse: choose(generator, &REVERSES),
    };
    let weights = weights(shape.layout(), generator);
    NoisePredictor::new(shape, weights, Precision::F32)
}

#[test]
fn gradients_match_finite_differences() -> Result<()> {
    // Number of hidden layers; norm before (false) or after the activation, if any.
    let (before, after) = (Some(false), Some(true));
    let norms = [(1, None), (3, None), (1, before), (2, before), (2, after)];
    let cases = ACTIVATIONS.into_iter().flat_map(|f| norms.map(|norm| (f, norm)));
    for (activation, (depth, norm)) in cases {
        let generator = &mut ChaCha8Rng::seed_from_u64(depth as u64);
        let mut layers = MlpConfig::mish(&[24, 32, 7][..depth]);
        layers.activation = activation;
        (layers.norm, layers.norm_after) = (norm.is_some(), norm == after);
        let shape = EnsembleShape::critics(2, (4, 3), &layers).with_outputs(2);
        let networks = ensemble(generator, &shape);
        let s = Var::from_tensor(&tensor(generator, (5, 4)))?;
        let a = Var::from_tensor(&tensor(generator, (10, 3)))?;
        let gradients = Gradients::backward(&loss(&networks.outputs(&s, &a)?)?)?;
        let w_gradient = gradients.with_respect_to(networks.weights())?;
        let [s_gradient, a_gradient] = [&s, &a].map(|x| gradients.store.get(x).unwrap());
        let (w, s, a) = (networks.weights().values().detach(), s.detach(), a.detach());
        let outputs = |w: &Tensor, s: &Tensor, a: &Tensor| {
            let weights = Weights::constant(shape.layout(), w.clone());
            Ensemble::new(shape.clone(), weights, Precision::F32).outputs(s, a)
        };
        let name = |argument: &str| format!("{argument}: {layers:?}");
        let check = |argument, x, gradient, outputs: &dyn Fn(&Tensor) -> Result<Tensor>| {
            check_gradient((&name(argument), 1e-3, 0.02), (x, gradient), outputs)
        };
        check("weights", &w, &w_gradient, &|w| outputs(w, &s, &a))?;
        check("observations", &s, s_gradient, &|s| outputs(&w, s, &a))?;
        check("actions", &a, a_gradient, &|a| outputs(&w, &s, a))?;

        // Many steps: clipping leaves the first ones no gradient.
        let predictor = noise_predictor(generator, layers.clone(), 8);
        let shape = predictor.shape();
        let s = tensor(generator, (60, shape.observation_dim));
        let z = tensor(generator, (8, 60, shape.action_dim));
        let samples = predictor.sample_with_gradient(&s, &z)?;
        let w_gradient = gradient(&samples, predictor.weights())?;
        let w = predictor.weights().values().detach();
        // Clipping has corners, hence the tolerance.
        check_gradient((&name("sampler"), 2e-5, 0.1), (&w, &w_gradient), |w| {
            let weights = Weights::constant(shape.layout(), w.clone());
            let predictor = NoisePredictor::new(shape.clone(), weights, Precision::F32);
            predictor.sample_with_gradient(&s, &z)
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
        let states = generator.random_range(1..200);
        let repeat = match shape.action_dim {
            0 => 1,
            _ => generator.random_range(1..4),
        };
        let rows = states * repeat;
        let s = tensor(generator, (states, shape.observation_dim));
        let a = Var::from_tensor(&tensor(generator, (rows, shape.action_dim)))?;
        let close = |name: &str, actual: &Tensor, expected: &Tensor| {
            let name = format!("{name}: {shape:?}, {rows} rows of {states}");
            assert_close(&name, actual, expected);
        };
        let outputs = || networks.outputs(&s, &a);
        let (fast, plain) = (outputs()?, plainly(outputs)?);
        close("outputs", &fast, &plain);
        let constants = networks.detach().outputs(&s, &a.detach())?;
        close("constants", &constants, &plain);
        let gradients = |loss: &Tensor| {
            let gradients = Gradients::backward(loss)?;
            let w_gradient = gradients.with_respect_to(networks.weights())?.copy()?;
            Result::Ok((w_gradient, gradients.store.get(&a).cloned()))
        };
        let (fast, plain) = (gradients(&loss(&fast)?)?, gradients(&loss(&plain)?)?);
        close("gradient of weights", &fast.0, &plain.0);
        let twice = gradients(&(loss(&outputs()?)? + loss(&outputs()?)?)?)?;
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
    let shape = shape(generator);
    let networks = ensemble(generator, &shape);
    let weights = networks.weights();
    let s = tensor(generator, (9, shape.observation_dim));
    let a = tensor(generator, (9, shape.action_dim));
    let outputs = || networks.outputs(&s, &a);
    let first = gradient(&outputs()?, weights)?;
    let overwritten = Gradients::backward(&loss(&outputs()?)?)?;
    let second = gradient(&outputs()?, weights)?;
    assert_eq!(numbers(&first), numbers(&second));
    if has_fast_implementation(&Device::Cpu) {
        assert!(overwritten.with_respect_to(weights).is_err());
        let outside = loss(&outputs()?)?.backward();
        assert!(outside.is_err(), "outside of `Gradients::backward`");
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
        let predict = || actor.predict(&s, &a, &t);
        let (fast, plain) = (predict()?, plainly(predict)?);
        assert_close("predictions", &fast, &plain);
        assert_close("constants", &actor.detach().predict(&s, &a, &t)?, &plain);
        let [fast, plain] = [fast, plain].map(|x| gradient(&x, actor.weights()));
        let name = format!("{:?}, {rows} rows", actor.shape());
        assert_close(&name, &fast?, &plain?);

        let repeat = generator.random_range(1..12);
        let noise = tensor(generator, (steps, rows * repeat, action_dim));
        let sample = || actor.sample(&s, &noise);
        let (fast, plain) = (sample()?, plainly(sample)?);
        let differentiable = actor.sample_with_gradient(&s, &noise)?;
        // Each denoising step magnifies rounding.
        assert_within(1e-4, "samples", &fast, &plain);
        assert_within(1e-4, "with gradient", &fast, &differentiable);
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
        for count in 0..3 {
            let gradient = tensor(generator, fast.values().shape());
            let mut step = AdamStep::after(count, 0.01);
            step.clip = clip;
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
        let (mean, variance) = mean_and_variance(&x)?;
        let plain = plainly(|| mean_and_variance(&x))?;
        assert_close("mean", &mean, &plain.0);
        assert_close("variance", &variance, &plain.1);
    }
    Ok(())
}

#[test]
fn bf16_is_close_to_f32_and_follows_the_weights() -> Result<()> {
    let generator = &mut ChaCha8Rng::seed_from_u64(3);
    let shape = EnsembleShape::critics(3, (11, 3), &MlpConfig::mish(&[64; 3]));
    let weights = ensemble(generator, &shape).weights().values().detach();
    let s = tensor(generator, (192, 11));
    let a = Var::from_tensor(&tensor(generator, (192, 3)))?;
    let network = |precision| {
        let weights = Weights::trainable(shape.layout(), &weights)?;
        Result::Ok(Ensemble::new(shape.clone(), weights, precision))
    };
    let results = |precision| {
        let network = network(precision)?;
        let values = network.values(&s, &a)?;
        let gradients = Gradients::backward(&loss(&values)?)?;
        Result::Ok([
            values,
            network.detach().values(&s, &a.detach())?,
            gradients.with_respect_to(network.weights())?.copy()?,
            gradients.store.get(&a).unwrap().clone(),
            network.action_gradients(&s, &a)?,
        ])
    };
    let rounds = Precision::Bf16.is_available() && has_fast_implementation(&Device::Cpu);
    let (exact, rounded) = (results(Precision::F32)?, results(Precision::Bf16)?);
    for (x, y) in exact.iter().zip(&rounded) {
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
