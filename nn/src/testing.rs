//! Helpers of tests.

use crate::gradients::gradient::Gradients;
use crate::slices::plainly;
use crate::weights::{Layout, Weights};
use candle_core::{DType, Device, Result, Shape, Tensor, Var};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Numbers from U(−1, 1), a function of the seed.
pub(crate) fn random(shape: impl Into<Shape>, seed: u64) -> Tensor {
    tensor(&mut ChaCha8Rng::seed_from_u64(seed), shape)
}

/// Numbers from U(−1, 1).
pub(crate) fn tensor(generator: &mut ChaCha8Rng, shape: impl Into<Shape>) -> Tensor {
    let shape = shape.into();
    let numbers = (0..shape.elem_count()).map(|_| generator.random_range(-1.0f32..1.0));
    Tensor::from_vec(numbers.collect(), shape, &Device::Cpu).unwrap()
}

/// Trainable weights: initial ones plus a little, so that biases are not 0.
pub(crate) fn weights(layout: Layout, generator: &mut ChaCha8Rng) -> Weights {
    let noise = (tensor(generator, layout.count()) * 0.1).unwrap();
    let values = (Weights::initial(&layout, generator, &Device::Cpu).unwrap() + noise).unwrap();
    Weights::trainable(layout, &values).unwrap()
}

pub(crate) fn numbers(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

/// Asserts that two tensors are equal up to rounding.
pub(crate) fn assert_close(name: &str, actual: &Tensor, expected: &Tensor) {
    assert_within(2e-5, name, actual, expected);
}

/// Asserts that errors are within a tolerance, relative to the root mean square.
pub(crate) fn assert_within(tolerance: f32, name: &str, actual: &Tensor, expected: &Tensor) {
    assert_eq!(actual.dims(), expected.dims(), "{name}");
    let (actual, expected) = (numbers(actual), numbers(expected));
    let size = (expected.iter().map(|x| x * x).sum::<f32>() / expected.len() as f32).sqrt();
    for (i, (x, y)) in actual.iter().zip(&expected).enumerate() {
        let error = (x - y).abs() / (size.max(1e-3) + 5.0 * y.abs());
        assert!(error <= tolerance, "{name} at {i}: {x} for {y}");
    }
}

/// A loss that depends on every output in its own way, in the outputs' type.
pub(crate) fn loss(outputs: &Tensor) -> Result<Tensor> {
    let factors = Tensor::arange(0f32, outputs.elem_count() as f32, &Device::Cpu)?.sin()?;
    (outputs.flatten_all()? * factors.to_dtype(outputs.dtype())?)?.sqr()?.sum_all()
}

/// The gradient of [`loss`] with respect to weights.
pub(crate) fn gradient(outputs: &Tensor, weights: &Weights) -> Result<Tensor> {
    Gradients::backward(&loss(outputs)?)?.with_respect_to(weights)?.copy()
}

/// Compares the gradient of [`loss`] at an argument of `outputs` with finite differences, along the
/// gradient and along a random direction. `tolerance` is relative to the gradient's norm.
pub(crate) fn check_gradient(
    (name, step, tolerance): (&str, f64, f64),
    (x, gradient): (&Tensor, &Tensor),
    outputs: impl Fn(&Tensor) -> Result<Tensor>,
) -> Result<()> {
    let norm = |x: &Tensor| Result::Ok(f64::from(x.sqr()?.sum_all()?.to_scalar::<f32>()?).sqrt());
    let size = norm(gradient)?;
    assert!(size > 1e-3, "{name}: no gradient");
    for direction in [gradient.detach(), random(x.shape(), 1)] {
        let direction = (&direction / norm(&direction)?)?;
        let value = |by: f64| {
            let x = (x + (&direction * by)?)?;
            loss(&outputs(&x)?.to_dtype(DType::F64)?)?.to_scalar::<f64>()
        };
        let slope = |by: f64| Result::Ok((value(by)? - value(-by)?) / (2.0 * by));
        // Richardson extrapolation
        let actual = (4.0 * slope(step / 2.0)? - slope(step)?) / 3.0;
        let expected = f64::from((gradient * &direction)?.sum_all()?.to_scalar::<f32>()?);
        let error = (actual - expected).abs() / size;
        assert!(error < tolerance, "{name}: {actual} for {expected}");
    }
    Ok(())
}

/// [`check_gradient`] for each argument of an operation.
pub(crate) fn check_gradients(
    name: &str,
    arguments: &[Tensor],
    outputs: impl Fn(&[Tensor]) -> Result<Tensor>,
) -> Result<()> {
    let variables = arguments.iter().map(Var::from_tensor);
    let variables = variables.collect::<Result<Vec<_>>>()?;
    let tensors = Vec::from_iter(variables.iter().map(|x| x.as_tensor().clone()));
    let gradients = loss(&outputs(&tensors)?)?.backward()?;
    for (i, variable) in variables.iter().enumerate() {
        let gradient = gradients.get(variable).unwrap();
        let name = format!("{name}, argument {i}");
        check_gradient((&name, 1e-3, 0.01), (&arguments[i], gradient), |x| {
            let mut arguments = arguments.to_vec();
            arguments[i] = x.clone();
            outputs(&arguments)
        })?;
    }
    Ok(())
}

/// Compares an operation with its plain implementation, and the gradients of both with finite
/// differences.
pub(crate) fn check_operation(
    name: &str,
    arguments: &[Tensor],
    outputs: impl Fn(&[Tensor]) -> Result<Tensor> + Copy,
) -> Result<()> {
    let fast = outputs(arguments)?;
    assert_close(name, &fast, &plainly(|| outputs(arguments))?);
    check_gradients(name, arguments, outputs)?;
    plainly(|| check_gradients(name, arguments, outputs))
}
