//! Tests: candle's gradients against differences of the loss.

use candle_core::{Device, Result, Shape, Tensor, Var};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// How far an argument is moved, in each direction.
const STEP: f32 = 1e-2;

/// Numbers in ±1, a function of the seed.
pub(crate) fn random(shape: impl Into<Shape>, seed: u64) -> Tensor {
    let (shape, mut generator) = (shape.into(), ChaCha8Rng::seed_from_u64(seed));
    let numbers: Vec<f32> =
        (0..shape.elem_count()).map(|_| generator.random_range(-1.0..1.0)).collect();
    Tensor::from_vec(numbers, shape, &Device::Cpu).unwrap()
}

/// A sum of what comes out with weights of both signs, in f64: sums of many numbers would hide
/// small differences.
fn loss(out: &Tensor) -> f64 {
    let weights = random(out.shape(), 99).flatten_all().unwrap().to_vec1::<f32>().unwrap();
    let numbers = out.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    numbers.iter().zip(&weights).map(|(x, weight)| f64::from(*x) * f64::from(*weight)).sum()
}

/// Checks the gradient with respect to each number of each argument, of a function of these.
pub(crate) fn check_gradients(arguments: &[Tensor], of: impl Fn(&[Tensor]) -> Result<Tensor>) {
    let variables: Vec<Var> = arguments.iter().map(|x| Var::from_tensor(x).unwrap()).collect();
    let tensors: Vec<Tensor> = variables.iter().map(|x| x.as_tensor().clone()).collect();
    let out = of(&tensors).unwrap();
    let weighted = (&out * random(out.shape(), 99)).unwrap().sum_all().unwrap();
    let gradients = weighted.backward().unwrap();
    for (place, variable) in variables.iter().enumerate() {
        let gradient =
            gradients.get(variable).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let numbers = arguments[place].flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let at = |i: usize, by: f32| {
            let mut moved = numbers.clone();
            moved[i] += by;
            let mut arguments = arguments.to_vec();
            arguments[place] =
                Tensor::from_vec(moved, arguments[place].shape(), &Device::Cpu).unwrap();
            loss(&of(&arguments).unwrap())
        };
        for (i, found) in gradient.iter().enumerate() {
            let slope = |by: f32| (at(i, by) - at(i, -by)) / (2.0 * f64::from(by));
            // What two of them say together is exact up to the fourth power of the step
            // (Richardson).
            let expected = ((4.0 * slope(STEP / 2.0) - slope(STEP)) / 3.0) as f32;
            let error = (found - expected).abs() / expected.abs().max(1.0);
            assert!(
                error < 5e-3,
                "argument {place} at {i}: {found}, but differences say {expected}"
            );
        }
    }
}
