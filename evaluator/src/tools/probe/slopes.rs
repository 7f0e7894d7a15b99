//! True slopes of the value beside the critics'.

use quad_run::results::statistics::mean;

use super::grid::means;
use super::noisy::Noisy;
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
    /// λ of Eq. 24, which takes all samples.
    pub lambda: f64,
    /// Along the gradients of [`DIRECTIONS`]: the gradient's size, and the true slope.
    pub along: [[f64; 2]; 3],
}

pub const DIRECTIONS: [&str; 3] =
    ["each critic's gradient", "the critics' mean gradient", "at the denoised estimate"];

/// Takes central differences over ±`h` in each dimension of each action, in two rollouts or more;
/// `returns` gives the returns of queries.
pub fn measure<'a>(
    noisy: &[Noisy],
    states: &'a [State],
    h: f32,
    returns: impl FnOnce(&[Query<'a>]) -> anyhow::Result<Vec<f64>>,
) -> anyhow::Result<Vec<Sample>> {
    let mut queries = Vec::new();
    for Noisy { state, action, .. } in noisy {
        let state = &states[*state];
        for &seed in &state.rollouts {
            for (axis, step) in (0..action.len()).flat_map(|axis| [(axis, h), (axis, -h)]) {
                let mut action = action.clone();
                action[axis] += step;
                queries.push(Query { state, action, seed });
            }
        }
    }
    let (returns, per_change) = (returns(&queries)?, 1.0 / (2.0 * f64::from(h)));
    let mut slopes = returns.chunks_exact(2).map(|pair| (pair[0] - pair[1]) * per_change);
    let sample = |noisy: &Noisy| {
        let of_rollout = |_: &u64| Vec::from_iter(slopes.by_ref().take(noisy.action.len()));
        noisy.sample(&Vec::from_iter(states[noisy.state].rollouts.iter().map(of_rollout)))
    };
    Ok(noisy.iter().map(sample).collect())
}

impl Noisy {
    /// `slopes` are the true gradients of the rollouts.
    fn sample(&self, slopes: &[Vec<f64>]) -> Sample {
        let Self { state, t, direction, gradients, denoised, .. } = self;
        let along_u = |gradients: &[Vec<f64>]| {
            Vec::from_iter(gradients.iter().map(|gradient| dot(gradient, direction)))
        };
        let [estimate, variance] = moments(&along_u(gradients));
        let [truth, spread] = moments(&along_u(slopes));
        let true_gradient = means(slopes);
        let along = |gradients: &[Vec<f64>]| {
            let sizes = Vec::from_iter(gradients.iter().map(|of| dot(of, of).sqrt()));
            let pairs = gradients.iter().zip(&sizes);
            let slopes = pairs.map(|(of, size)| dot(of, &true_gradient) / size);
            [mean(&sizes), mean(&Vec::from_iter(slopes))]
        };
        Sample {
            state: *state,
            t: *t,
            estimate,
            variance,
            denoised: dot(denoised, direction),
            truth,
            noise: spread / (slopes.len() as f64 - 1.0),
            lambda: f64::NAN,
            along: [
                along(gradients),
                along(&[means(gradients)]),
                along(std::slice::from_ref(denoised)),
            ],
        }
    }
}

fn dot(x: &[f64], y: &[f64]) -> f64 {
    x.iter().zip(y).map(|(x, y)| x * y).sum()
}

/// Mean and population variance.
fn moments(values: &[f64]) -> [f64; 2] {
    let center = mean(values);
    let squares = values.iter().map(|x| (x - center) * (x - center));
    [center, mean(&Vec::from_iter(squares))]
}
