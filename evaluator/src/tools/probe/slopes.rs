//! True gradients beside the critics'.

use std::sync::Arc;

use quad_run::results::statistics::mean;

use super::oracle::Query;
use super::points::Point;
use super::states::State;

/// Slopes of the value at a noisy action.
#[derive(Clone)]
pub struct Sample {
    /// Index of its state.
    pub state: usize,
    pub t: usize,
    /// l̄ of Eq. 22: the mean over critics of the slope u·∇Q_k along the predicted noise.
    pub estimate: f64,
    /// σ² of Eq. 22.
    pub variance: f64,
    /// u·∇Q at the denoised estimate, of the critics' mean.
    pub denoised: f64,
    /// The true u·g*, a mean over rollouts.
    pub truth: f64,
    /// Variance of that mean.
    pub noise: f64,
    /// Along the gradients themselves, [`DIRECTIONS`]: the critics' slope, then the true one.
    pub along: [[f64; 2]; 3],
}

/// Gradients whose directions are measured.
pub const DIRECTIONS: [&str; 3] =
    ["each critic's gradient", "the critics' mean gradient", "that at the denoised estimate"];

fn dot(x: &[f64], y: &[f64]) -> f64 {
    x.iter().zip(y).map(|(x, y)| x * y).sum()
}

/// Central differences over ±`h` in each dimension of each point's action. `seeds` are those of a
/// state's rollouts, two or more; `returns` gives the queries' returns.
pub fn measure(
    points: &[Point],
    states: &[Arc<State>],
    seeds: &[Vec<u64>],
    h: f32,
    returns: impl FnOnce(Vec<Query>) -> anyhow::Result<Vec<f64>>,
) -> anyhow::Result<Vec<Sample>> {
    let of_rollout = |point: &Point, seed: u64, queries: &mut Vec<Query>| {
        for axis in 0..point.action.len() {
            for step in [h, -h] {
                let (state, mut action) = (states[point.state].clone(), point.action.clone());
                action[axis] += step;
                queries.push(Query { state, action, seed });
            }
        }
    };
    let mut queries = Vec::new();
    for point in points {
        seeds[point.state].iter().for_each(|seed| of_rollout(point, *seed, &mut queries));
    }
    let returns = returns(queries)?;
    let slope = |pair: &[f64]| (pair[0] - pair[1]) / (2.0 * f64::from(h));
    let slopes = Vec::from_iter(returns.chunks_exact(2).map(slope));
    let mut slopes = slopes.as_slice();
    let samples = points.iter().map(|point| {
        let of_point = slopes.split_at(seeds[point.state].len() * point.action.len());
        slopes = of_point.1;
        sample(point, of_point.0)
    });
    Ok(samples.collect())
}

/// `slopes` has the true gradient of each rollout.
fn sample(point: &Point, slopes: &[f64]) -> Sample {
    let Point { state, t, ref direction, ref gradients, ref denoised, .. } = *point;
    let rollouts = slopes.chunks_exact(direction.len());
    let count = rollouts.len() as f64;
    let of_rollouts = Vec::from_iter(rollouts.map(|gradient| dot(gradient, direction)));
    let truth = mean(&of_rollouts);
    let squares = of_rollouts.iter().map(|slope| (slope - truth).powi(2)).sum::<f64>();

    let by_axis = |of: &mut dyn FnMut(usize) -> f64| Vec::from_iter((0..direction.len()).map(of));
    let true_gradient =
        by_axis(&mut |axis| slopes.iter().skip(axis).step_by(direction.len()).sum::<f64>() / count);
    let critics = gradients.len() as f64;
    let mean_gradient =
        by_axis(&mut |axis| gradients.iter().map(|gradient| gradient[axis]).sum::<f64>() / critics);
    let along = |gradient: &[f64]| {
        let size = dot(gradient, gradient).sqrt();
        [size, dot(gradient, &true_gradient) / size.max(f64::MIN_POSITIVE)]
    };
    let of_critics = Vec::from_iter(gradients.iter().map(|gradient| along(gradient)));
    let of_critics =
        [0, 1].map(|which| of_critics.iter().map(|of| of[which]).sum::<f64>() / critics);

    let alignments = Vec::from_iter(gradients.iter().map(|gradient| dot(gradient, direction)));
    let estimate = mean(&alignments);
    Sample {
        state,
        t,
        estimate,
        variance: mean(&Vec::from_iter(alignments.iter().map(|l| (l - estimate).powi(2)))),
        denoised: dot(denoised, direction),
        truth,
        noise: squares / (count - 1.0) / count,
        along: [of_critics, along(&mean_gradient), along(denoised)],
    }
}
