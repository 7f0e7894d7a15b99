//! True slopes of the value beside the critics'.

use std::sync::Arc;

use candle_core::{D, Device, Result, Tensor};

use super::noisy::{Noisy, norm};
use super::oracle::Query;
use super::states::State;

/// Slopes of the value at a noisy action.
#[derive(Clone, Default)]
pub struct Sample {
    /// Index of its state.
    pub state: usize,
    pub t: usize,
    /// l̄ and σ² of Eq. 22: over critics, of the slope u·∇Q_k along the predicted noise.
    pub estimate: f64,
    pub variance: f64,
    /// u·∇Q at the denoised estimate, of the critics' mean.
    pub denoised: f64,
    /// The true u·g*, a mean over rollouts, and that mean's variance.
    pub truth: f64,
    pub noise: f64,
    /// λ of Eq. 24.
    pub lambda: f64,
    /// Along the gradients of [`DIRECTIONS`]: the gradient's size, and the true slope.
    pub along: [[f64; 2]; 3],
}

pub const DIRECTIONS: [&str; 3] =
    ["each critic's gradient", "the critics' mean gradient", "at the denoised estimate"];

/// Mean and population variance over a dimension, in `f64`; `quad_nn::mean_and_variance` has `f32`.
fn moments(x: &Tensor, dim: usize) -> Result<[Tensor; 2]> {
    let mean = x.mean_keepdim(dim)?;
    let variance = x.broadcast_sub(&mean)?.sqr()?.mean(dim)?;
    Ok([mean.squeeze(dim)?, variance])
}

/// Takes central differences over ±`h` in each dimension of each action. `seeds` are those of a
/// state's rollouts, two or more; `returns` gives the returns of queries.
pub fn measure(
    noisy: &Noisy,
    states: &[Arc<State>],
    seeds: &[Vec<u64>],
    h: f32,
    returns: impl FnOnce(Vec<Query>) -> anyhow::Result<Vec<f64>>,
) -> anyhow::Result<Vec<Sample>> {
    let mut queries = Vec::new();
    for ((state, _), action) in noisy.of.iter().zip(noisy.actions.to_vec2::<f64>()?) {
        let action = Vec::from_iter(action.iter().map(|x| *x as f32));
        for &seed in &seeds[*state] {
            for (axis, step) in (0..action.len()).flat_map(|axis| [(axis, h), (axis, -h)]) {
                let (state, mut action) = (states[*state].clone(), action.clone());
                action[axis] += step;
                queries.push(Query { state, action, seed });
            }
        }
    }
    let returns = returns(queries)?;
    let (n, a) = noisy.actions.dims2()?;
    let returns = Tensor::from_vec(returns, (n, (), a, 2), &Device::Cpu)?;
    let [above, below] = [returns.narrow(3, 0, 1)?, returns.narrow(3, 1, 1)?];
    let slopes = ((above - below)?.squeeze(3)? / (2.0 * f64::from(h)))?; // [n, rollouts, a]
    Ok(samples(noisy, &slopes)?)
}

fn samples(noisy: &Noisy, slopes: &Tensor) -> Result<Vec<Sample>> {
    let Noisy { of, directions, gradients, denoised, .. } = noisy;
    let dot = |x: &Tensor, y: &Tensor| x.broadcast_mul(y)?.sum(D::Minus1);
    let along_u = directions.unsqueeze(1)?;
    let [estimate, variance] = moments(&dot(gradients, &along_u)?, 1)?;
    let [truth, spread] = moments(&dot(slopes, &along_u)?, 1)?;
    let noise = (spread / (slopes.dim(1)? as f64 - 1.0))?;
    let true_gradient = slopes.mean(1)?.unsqueeze(1)?; // [n, 1, a]
    // Mean size of some gradients, [n, …, a], and the mean slope along them.
    let along = |gradients: &Tensor| {
        let size = norm(gradients)?;
        Result::Ok([size.mean(1)?, (dot(gradients, &true_gradient)? / size)?.mean(1)?])
    };
    let [each, true_of_each] = along(gradients)?;
    let [mean, true_of_mean] = along(&gradients.mean_keepdim(1)?)?;
    let [there, true_of_there] = along(&denoised.unsqueeze(1)?)?;
    let along = [each, true_of_each, mean, true_of_mean, there, true_of_there];
    let columns = [estimate, variance, dot(denoised, directions)?, truth, noise];
    let columns = Vec::from_iter(columns.into_iter().chain(along));
    let rows = Tensor::stack(&columns, 1)?.to_vec2::<f64>()?;
    let sample = |(row, &(state, t)): (&Vec<f64>, &(usize, usize))| Sample {
        state,
        t,
        estimate: row[0],
        variance: row[1],
        denoised: row[2],
        truth: row[3],
        noise: row[4],
        lambda: f64::NAN, // It takes all samples.
        along: [[row[5], row[6]], [row[7], row[8]], [row[9], row[10]]],
    };
    Ok(rows.iter().zip(of).map(sample).collect())
}
